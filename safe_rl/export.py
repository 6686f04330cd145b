"""``python -m safe_rl.export``: see :mod:`safe_rl.cli.export`."""

import sys

from safe_rl.cli.export import main

if __name__ == "__main__":
    sys.exit(main())
