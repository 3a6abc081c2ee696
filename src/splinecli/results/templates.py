"""The templates of the HTML pages, in `assets`. Every page extends base.html; parts.html has shared parts."""

import base64

from splinecli import __version__


def picture_url(file: bytes, kind: str = "png") -> str:
    """Return a data URL of a PNG or JPEG file, so that a page contains it."""
    return f"data:image/{kind};base64,{base64.b64encode(file).decode('ascii')}"


def render(template: str, **values: object) -> str:
    """Return the page that a template makes of the values. Values are escaped; a missing value is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("splinecli", "assets"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(version=__version__, **values).rstrip() + "\n"
