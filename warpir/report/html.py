"""Self-contained HTML pages from jinja2 templates, with every value escaped.

Style and script stand in the page, named by their hashes in its content security policy, so that
nothing else in it can run.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

import warpir


def source_hash(source: bytes) -> str:
    """Return a style or script as a policy's source expression, ``'sha256-...'`` (CSP 3, 2.3.1)."""
    digest = hashlib.sha256(source).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def render_page(
    name: str,
    *,
    package: str = "warpir.report",
    style: str = "report",
    images: str = "data:",
    scripts: Sequence[str] = (),
    connections: str = "'none'",
    **values: Any,
) -> bytes:
    """Fill a template and return the page, in UTF-8.

    Args:
        name: ``NAME.html.j2`` in the package's ``templates`` or in this package's own.
        package: Package of the templates that are looked up first.
        style: ``STYLE.css`` and ``STYLE.js`` beside the template.
        images: Sources of images for the content security policy.
        scripts: Sources of scripts beside the page's own.
        connections: Sources of what the script reads.
        **values: What the template names; each is escaped.
    """
    environment = _environment(package)
    css, js = (_source(environment, f"{style}.{kind}") for kind in ("css", "js"))
    allowed = " ".join([source_hash(js.encode()), *scripts])
    policy = (
        f"default-src 'none'; img-src {images}; style-src {source_hash(css.encode())}; "
        f"script-src {allowed}; connect-src {connections}; base-uri 'none'; form-action 'none'"
    )
    page = environment.get_template(f"{name}.html.j2").render(
        css=css, js=js, policy=policy, version=warpir.__version__, **values
    )
    return page.encode("utf-8", "replace")  # file names may hold bytes that are no text


@cache
def _environment(package: str) -> Environment:
    loaders = [PackageLoader(name) for name in dict.fromkeys((package, "warpir.report"))]
    return Environment(
        loader=ChoiceLoader(loaders),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _source(environment: Environment, name: str) -> str:
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]
