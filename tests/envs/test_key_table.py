"""The table of configuration keys is what the checks use, and says something of every key."""

import re

import pytest
from registrations import register_mines, undone

from safe_rl.envs import ConfigError, SafetyGymConfig, key_table

OUTSIDE = {
    "one of ('cpu', 'warp')": "jax",
    "greater than 0": 0,
    "0 or more": -1,
    "a probability between 0 and 1": 1.5,
    "one of ('pseudo', 'natural')": "laser",
    "one of (2, 3)": 4,
}
ROWS = {row.name: row for row in key_table()}


def test_every_key_has_a_row_that_says_what_it_is():
    assert {name: row.default for name, row in ROWS.items()} == SafetyGymConfig().to_dict()
    assert all(row.type and len(row.meaning) > 4 for row in ROWS.values())
    assert ROWS["num_steps"] == (
        *("num_steps", "integer", "greater than 0"),
        *("steps after which an episode is truncated", 1000),
    )


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.range])
def test_the_range_it_names_is_the_range_that_is_checked(name):
    row = ROWS[name]
    wanted, _, bound = row.range.partition(", at most ")
    outside = {wanted: OUTSIDE[wanted]}
    if bound:
        outside[f"at most {bound}"] = int(bound.replace(",", "")) + 1
    for words, value in outside.items():
        with pytest.raises(ConfigError, match=f"'{name}' must be {re.escape(words)}"):
            SafetyGymConfig.from_dict({name: [value, 40] if row.type == "two integers" else value})
    assert SafetyGymConfig.from_dict({name: row.default}) == SafetyGymConfig()


def test_keys_without_a_range_take_any_number():
    free = [row.name for row in ROWS.values() if row.type == "number" and not row.range]
    assert {"reward_goal", "placements_margin", "vases_sink"} <= set(free)
    config = SafetyGymConfig.from_dict(dict.fromkeys(free, -1e6))
    assert config.reward_goal == -1e6


def test_registered_keys_stand_in_it():
    with undone():
        register_mines()
        rows = {row.name: row for row in key_table()}
        assert rows.keys() - ROWS.keys() >= {"mines_num", "mines_size", "mines_cost"}
        assert rows["mines_num"].range == "0 or more, at most 1,000"
        assert rows["mines_size"][1:3] == ("number", "greater than 0")
    assert [row.name for row in key_table()] == list(ROWS)
