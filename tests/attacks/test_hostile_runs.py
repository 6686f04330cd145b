"""Files of a run that somebody else has changed: every command uses them, or says why not."""

import json
import os
import shutil
import signal

import pytest
import torch
import yaml
from attacking import RUN, cases
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from run_configs import compose_config

import safe_rl
from safe_rl.evaluation.policies import pack_policy
from safe_rl.files import load_tensors, save_tensors
from safe_rl.training.train import is_expected, train

MARK = "\x1b[31m"
# 1e30: torch itself refuses what single precision cannot hold
VALUES = (None, True, -1, 3, 1e30, float("nan"), "", "x", MARK, "../..", [], [1], {}, {"a": MARK})
REPLAY = [word for word in RUN if not word.startswith("critic_update")]
REPLAY += ["algo=sac_lagrangian", "exploration.random_steps=80", "memory.batch_size=8"]
REPLAY += ["memory.keep=true", "memory.n_steps=3", "certificate.episodes=0"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A certified and evaluated run with a recording, and a run with a replay buffer."""
    folder, replay = (tmp_path_factory.mktemp("trained") / name for name in ("run", "replay"))
    test = ["certificate.ranking=2", "certificate.episodes=20", "cost_limits={cost: 1000}"]
    train(compose_config(*RUN, "frames=160", "record=true", *test), folder)
    safe_rl.evaluate(folder, episodes=2, num_envs=2, num_threads=1)
    train(compose_config(*REPLAY, "frames=160"), replay)
    return folder, replay


def change_bytes(random, path):
    content = bytearray(path.read_bytes())
    for _ in range(random.randint(1, 8)):
        content[random.randrange(len(content))] = random.randrange(256)
    path.write_bytes(content)


def cut(random, path):
    path.write_bytes(path.read_bytes()[: random.randrange(path.stat().st_size)])


def replace(random, path):
    path.unlink()
    kind = random.choice(["pipe", "link", "folder", "json", "sparse"])
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(random.choice(["/etc/passwd", "/dev/zero", path.name, "nowhere"]))
    elif kind == "folder":
        path.mkdir()
    elif kind == "json":
        path.write_text(json.dumps(random.choice(VALUES)))
    else:
        path.touch()
        os.truncate(path, 2**37)


def edited(random, content):
    """Plain containers with another value somewhere."""
    if isinstance(content, dict) and content and random.random() < 0.9:
        key = random.choice(list(content))
        if random.random() < 0.1:
            return {name: value for name, value in content.items() if name != key}
        return {**content, key: edited(random, content[key])}
    if isinstance(content, list) and content and random.random() < 0.7:
        return [edited(random, content[0]), *content[1:]]
    if isinstance(content, torch.Tensor) and random.random() < 0.7:
        shorter = content[:0] if content.ndim else content - 9
        return random.choice([content.double() * torch.nan, content.unsqueeze(0), shorter])
    return random.choice(VALUES)


def edit(random, path):
    if path.suffix == ".json":
        path.write_text(json.dumps(edited(random, json.loads(path.read_text()))))
    elif path.suffix == ".torchrl":
        save_tensors(path, edited(random, load_tensors(path)))
    elif path.suffix == ".yaml":
        content = OmegaConf.to_container(OmegaConf.load(path))
        path.write_text(yaml.safe_dump(edited(random, content)))
    else:
        change_bytes(random, path)


def act(run):
    opened = safe_rl.load(run, imports=[])
    repr(opened)
    opened.env.rollout(3, opened.policy)


ACTIONS = {
    "load": act,
    "load certified": lambda run: safe_rl.load(run, "certified", imports=[]).policy,
    "evaluate": lambda run: safe_rl.evaluate(run, episodes=2, num_envs=2, num_threads=1),
    "certify": lambda run: safe_rl.load(run, imports=[]).certify(episodes=20),
    "resume": lambda run: safe_rl.resume(run, imports=[], frames=200),
    "export": lambda run: pack_policy(run, run.parent / "packed", "last"),
    "report": lambda run: safe_rl.report(run.parent),
    "init_from": lambda run: train(
        compose_config(*RUN, "frames=40", f"init_from='{run}'"), run.parent / "new"
    ),
}


def give_up(number, frame):
    raise AssertionError("it hangs")


# an older checkpoint is used instead of a damaged one
@pytest.mark.filterwarnings("ignore:Cannot use the checkpoint")
@pytest.mark.filterwarnings("ignore:The checkpoint .* is another run")
def test_changed_files_are_used_or_refused_in_a_line(trained, tmp_path, capfd):
    mine = tmp_path / "mine"
    mine.write_text("mine")
    signal.signal(signal.SIGALRM, give_up)
    for random in cases("hostile runs", 110, least=20):
        source = random.choice([*trained, trained[0]])
        run = shutil.copytree(source, tmp_path / "runs" / "run")
        path = random.choice([path for path in sorted(run.rglob("*")) if path.is_file()])
        change = random.choice([change_bytes, cut, replace, edit, edit, edit])
        name = random.choice(list(ACTIONS))
        print(change.__name__, source.name, path.relative_to(run), name, flush=True)
        if path.stat().st_size:
            change(random, path)
        signal.alarm(120)
        try:
            ACTIONS[name](run)
        except OmegaConfBaseException as error:
            said = str(error).partition("\n")[0]  # the next lines repeat the key
        except SystemExit as error:
            said = str(error)
        except Exception as error:
            if not is_expected(error):
                raise
            said = str(error)
        else:
            said = ""
        finally:
            signal.alarm(0)
        # a report without any run says what is wrong with the table, and what was left out
        assert len(said.splitlines()) <= 1 + 2 * said.startswith("There is no run to report")
        assert MARK not in said
        shutil.rmtree(tmp_path / "runs")
    assert mine.read_text() == "mine"
