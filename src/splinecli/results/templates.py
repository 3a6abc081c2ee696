"""The HTML pages' templates, in `assets`: each extends base.html, which holds what all pages share."""

from __future__ import annotations


def render(template: str, **values: object) -> str:
    """The page of a template of this name, every value escaped; a value that it lacks is a defect."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from splinecli import __version__

    environment = Environment(
        loader=PackageLoader("splinecli", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values).rstrip() + "\n"
