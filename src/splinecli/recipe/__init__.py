"""The steps that turn the stored pixels of a capture into reliable observations."""

from splinecli.recipe.steps import prepare_capture, read_capture
from splinecli.recipe.work import RecipeOptions

__all__ = ["RecipeOptions", "prepare_capture", "read_capture"]
