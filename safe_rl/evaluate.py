"""``python -m safe_rl.evaluate``: see :mod:`safe_rl.cli.evaluate`."""

import sys

from safe_rl.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
