"""The report as one HTML file: template, style, scripts and all data inside; nothing is fetched, nothing runs that a
file name says.

Text goes through the template's escaping or, in the page, through ``textContent``; data is JSON in which no ``<`` is
left, so that it cannot end its own element.
"""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

PROVENANCE_MARK = '<script type="application/json" id="provenance">null</script>'
"""Where whoever copies the report out may put what became known after it was written: times and reasons."""


def json_text(value: Any) -> str:
    """JSON that is safe inside an HTML script element."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def static(name: str) -> str:
    """A packaged file's text."""
    return resources.files("stages.reporting").joinpath("static", name).read_text(encoding="utf-8")


def render(data: dict[str, Any], model_uri: str) -> str:
    """The whole page.

    Args:
        data: what the page shows; see ``stages/report.py``.
        model_uri: the GLB as a data URI.
    """
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    template = environment.from_string(static("page.html.j2"))
    return template.render(
        data=data,
        data_json=safe(json_text(data)),
        model_uri=model_uri,
        style=safe(static("page.css")),
        three=safe(static("three.bundle.min.js")),
        scripts=safe("\n".join(static(name) for name in ("viewer.js", "charts.js", "page.js"))),
        provenance=safe(PROVENANCE_MARK),
    )


def safe(text: str) -> Any:
    """Text of our own files or of :func:`json_text`, not to be escaped again."""
    from markupsafe import Markup

    return Markup(text)
