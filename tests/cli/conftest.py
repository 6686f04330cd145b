"""What the tests of command lines share."""

from safe_rl.envs import store_configs

store_configs()
