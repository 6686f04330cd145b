"""The command ``train.py``: check what is asked for, compose a configuration, run it.

What trains is imported when a run begins, so that help and refusals come at once.
"""

import os
import sys
from collections.abc import Sequence

import hydra
from omegaconf import DictConfig

from safe_rl.cli.composing import check_command
from safe_rl.cli.conf import CONF
from safe_rl.cli.interrupting import say_interruptions
from safe_rl.cli.overrides import CommandLineError
from safe_rl.cli.settings import SettingError
from safe_rl.cli.shorthands import expand_arguments
from safe_rl.cli.user_code import import_modules, note_imports, split_imports
from safe_rl.envs import ConfigError, store_configs
from safe_rl.targets import TargetError

store_configs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def train(config: DictConfig) -> None:
    """Compose, build, train."""
    from safe_rl.cli.running import run

    run(config)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command: expand shorthands, check what is asked for, and hand over to Hydra."""
    say_interruptions()
    try:
        given = sys.argv[1:] if arguments is None else list(arguments)
        modules, given = split_imports(given)
        if modules is not None:
            import_modules(modules)
            given = note_imports(modules, given)
        expanded = expand_arguments(given)
        check_command(expanded, CONF)
    except (CommandLineError, SettingError, TargetError, ConfigError) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print(error, file=sys.stderr)
        return 1
    sys.argv[1:] = expanded
    train()
    return 0
