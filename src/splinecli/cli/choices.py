"""The names that options accept, taken from the modules that define them, without importing those at startup."""

from __future__ import annotations


def methods() -> list[str]:
    """Return what --method may be."""
    from splinecli.methods import method_names

    return method_names()


def normal_formats() -> list[str]:
    """Return the formats of normal maps."""
    from splinecli.results.files import NORMALS

    return list(NORMALS)


def maps() -> list[str]:
    """Return the optional maps of `infer`."""
    from splinecli.results.files import MAPS

    return list(MAPS)


IN_HELP = {"{methods}": methods, "{formats}": normal_formats, "{maps}": maps}
"""Words in the help of an option, each replaced by a list of names when the help is shown."""


def fill_in(text: str) -> str:
    """Return a help text with the words of IN_HELP replaced."""
    for word, names in IN_HELP.items():
        if word in text:
            *most, last = names()
            text = text.replace(word, f"{', '.join(most)} or {last}")
    return text
