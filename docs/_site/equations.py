"""Equations as MathML, which browsers show by themselves: no script, nothing from the network."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

_EQUATION = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<tex>.*?)\\[)\]]\s*</(?P=tag)>', re.DOTALL
)
_COMMAND = re.compile(r"\\[a-zA-Z]+")


def typeset(page: str) -> str:
    """Replace the equations of a page; ValueError for a command that is not known."""
    return _EQUATION.sub(_mathml, page)


def _mathml(match: re.Match[str]) -> str:
    tex = html.unescape(match["tex"])
    made = convert(tex, display="block" if match["tag"] == "div" else "inline")
    if unknown := _COMMAND.findall(made):
        raise ValueError(f"{unknown[0]} is not known in the equation {tex.strip()}")
    return f'<{match["tag"]} class="arithmatex">{made}</{match["tag"]}>'
