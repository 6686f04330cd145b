"""Train an algorithm on an environment: ``python train.py env=PointGoal1 algo=ppo_lagrangian``."""

import sys

from safe_rl.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
