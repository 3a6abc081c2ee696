"""The ordered steps from the stored pixels of a capture to trusted observations."""

from splinecli.recipe.steps import prepare_capture, read_capture
from splinecli.recipe.work import RecipeOptions

__all__ = ["RecipeOptions", "prepare_capture", "read_capture"]
