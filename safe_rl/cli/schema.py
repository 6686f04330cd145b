"""What `composing` needs until Hydra alone composes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_type_hints

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.checks import SettingError
from safe_rl.cli.config import General, check_settings
from safe_rl.naming import nearest
from safe_rl.runs.identity import flatten

__all__ = ["GIVEN_WHOLE", "KEYS", "check_settings", "plain", "unknown_key", "unread_by"]

GIVEN_WHOLE = {
    **{"cost_limits": "limits", "model.input_scale": "factors"},
    **{f"transforms.{t}.budgets": "budgets" for t in ("saute", "simmer", "early_termination")},
}
KEYS = get_type_hints(General)


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration as dictionaries and lists, without the node ``hydra``."""
    try:
        own = [str(k) for k in config if k != "hydra" and not OmegaConf.is_missing(config, k)]
        return OmegaConf.to_container(OmegaConf.masked_copy(config, own), resolve=True)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise SettingError(f"{error.full_key}: {str(error).partition(chr(10))[0]}") from None


def unknown_key(key: str, values: Mapping[str, Any]) -> str:
    """A message that a key does not exist, with the nearest one."""
    section = key.partition(".")[0]
    if section in KEYS and section not in values:
        return f"algo={values['algo'].get('name')} has no '{section}'."
    known = list(flatten(values))
    name = key.rpartition(".")[2]
    same = [path for path in known if path.rpartition(".")[2] == name]
    close = same or [*filter(None, [nearest(key, known, 0.6)])]
    meant = f" Did you mean {' or '.join(map(repr, close))}?" if close else ""
    return f"there is no key '{key}'.{meant}"


def unread_by(values: Mapping[str, Any]) -> Mapping[str, str]:
    """Nothing: an algorithm's page has no key that it does not read."""
    return {}
