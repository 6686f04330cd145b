"""What the certificate of a run asks for, from its configuration."""

import pytest
from run_configs import compose_config

from safe_rl.evaluation.settings import certificate_options
from safe_rl.runs.identity import is_to_keep_limits


@pytest.mark.parametrize(
    ("overrides", "share", "tail"),
    [
        ([], 1.0, 1.0),
        (["risk=cvar"], 1.0, 0.1),
        (["risk=chance"], 0.1, 1.0),
        (["risk=chance", "risk.most_over=0.2"], 0.2, 1.0),
        (["risk=chance", "certificate.most_over=0.05"], 0.05, 1.0),
        (["certificate.most_over=0.3"], 0.3, 1.0),
        (["algo=wcsac"], 1.0, 0.5),
        (["algo=wcsac", "risk=mean"], 1.0, 1.0),
    ],
)
def test_limits_on_shares_and_costliest_episodes_are_certified(overrides, share, tail):
    options = certificate_options(compose_config(*overrides))
    assert (options.most_over, options.tail) == (share, tail)


@pytest.mark.parametrize(
    ("overrides", "is_to"),
    [
        (["algo=cpo"], True),
        (["algo=ppo"], False),
        (["algo=ppo", "transforms=[early_termination]"], True),
        (["algo=ppo", "transforms=[sensor_noise]"], False),
    ],
)
def test_a_budget_of_a_transform_is_a_limit_to_keep(overrides, is_to):
    assert is_to_keep_limits(compose_config(*overrides)) == is_to


def test_options_are_replaced_and_wrong_ones_named():
    config = compose_config("algo=cpo", "certificate.episodes=0", "certificate.tests=2")
    assert certificate_options(config, {"level": 0.99}).level == 0.99
    # such a run ended without one; who asks for one gets the package's number
    assert certificate_options(config).episodes == compose_config().certificate.episodes
    assert certificate_options(config).tests == 2
    with pytest.raises(ValueError, match=r"no certificate\.episode\. Did you mean 'episodes'"):
        certificate_options(config, {"episode": 10})
    with pytest.raises(ValueError, match="it must be"):
        certificate_options(config, {"level": 1.5})
    with pytest.raises(ValueError, match="episodes=0: a test needs episodes"):
        certificate_options(config, {"episodes": 0})
