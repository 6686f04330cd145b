"""Roles of Sphinx in docstrings, as links where the site has what they name."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

_ROLE = re.compile(r":(?:class|func|mod|meth|data|attr|exc):`(?P<short>~?)(?P<name>[\w.]+)`")


def linked(text: str, scope: str = "") -> str:
    """Replace roles by optional cross-references, which are plain code where nothing is found."""

    def reference(match: re.Match[str]) -> str:
        name = match["name"]
        shown = name.rpartition(".")[2] if match["short"] else name
        target = name if name.startswith("safe_rl.") or "." in name else f"{scope}.{name}"
        return f'<autoref identifier="{target}" optional><code>{shown}</code></autoref>'

    return _ROLE.sub(reference, text)


class Roles(Extension):
    """Rewrites every docstring as it is read."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of an object, if it has one."""
        if not obj.is_alias and obj.docstring is not None:
            scope = obj.path if obj.is_class or obj.is_module else obj.path.rpartition(".")[0]
            obj.docstring.value = linked(obj.docstring.value, scope)
