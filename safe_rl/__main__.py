"""The command ``safe-rl train|evaluate|report …``, also ``python -m safe_rl …``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from safe_rl.naming import did_you_mean

COMMANDS = {
    "train": "train an algorithm on an environment, as python train.py does",
    "evaluate": "measure a trained policy on whole episodes",
    "certify": "test which checkpoint of a run keeps the limits",
    "export": "write a trained policy as ONNX, or as a small folder",
    "report": "summarise a folder of runs on one page",
}
USAGE = "\n".join(
    [
        "usage: safe-rl COMMAND [key=value ...]",
        "",
        *(f"  {name:<10} {meaning}" for name, meaning in COMMANDS.items()),
        "",
        "safe-rl COMMAND --help describes a command.",
    ]
)


def main(arguments: Sequence[str] | None = None) -> int | str:
    """Run a command with the rest of the command line; return its exit status."""
    name, *others = [*(sys.argv[1:] if arguments is None else arguments), ""]
    if name in COMMANDS:
        return import_module(f"safe_rl.cli.{name}").main(others[:-1])
    if name in ("", "-h", "--help"):
        print(USAGE)
        return 0 if name else 2
    print(f"Unknown command '{name}'.{did_you_mean(name, COMMANDS)}\n{USAGE}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
