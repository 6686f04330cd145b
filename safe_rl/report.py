"""``python -m safe_rl.report``: see :mod:`safe_rl.cli.report`."""

import sys

from safe_rl.cli.report import main

if __name__ == "__main__":
    sys.exit(main())
