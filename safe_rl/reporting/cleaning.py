"""Whatever names and files hold, as text that can be shown."""

from typing import Any

__all__ = ["clean"]

_LONGEST = 200


def clean(text: Any, most: int = _LONGEST) -> str:
    r"""Text as a page can show it: one line, printable, of bounded length.

    Examples:
        >>> clean("a\nb\x07"), clean("x" * 10, most=4)
        ('a b�', 'xxx…')
    """
    shown = "".join(c if c.isprintable() else " " if c.isspace() else "�" for c in str(text))
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"
