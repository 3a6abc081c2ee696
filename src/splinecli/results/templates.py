"""The templates of the HTML pages, in `assets`. Every page extends base.html; parts.html has shared parts."""

from splinecli import __version__


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
