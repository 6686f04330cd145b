"""Full disks, few files, little memory: a run says so in a line, and is continued exactly."""

import pytest
from attacking import RUN, cases, said_by, start
from run_configs import without_times

from safe_rl.runs.table import read_table

TRAIN = (
    "train.py",
    *RUN,
    "policy_update.minibatch_size=20",
    "frames=400",
    "certificate.episodes=0",
)


def lines_of(process):
    said = said_by(process)
    assert "Traceback" not in said, said
    return said


def test_a_run_on_a_full_disk_is_continued_exactly(tmp_path):
    assert "Return" in lines_of(start(*TRAIN, f"hydra.run.dir={tmp_path / 'whole'}"))
    for number, random in enumerate(cases("full disks", 60, least=3)):
        folder = tmp_path / f"full{number}"
        # the kernel's signal would end the process; without it, writing fails as on a full disk
        limits = f"trap '' XFSZ; ulimit -f {random.randint(1, 40)};"
        process = start(*TRAIN, f"hydra.run.dir={folder}", limits=limits)
        said = lines_of(process)
        again = [f"resume={folder}"] if (folder / "config.yaml").exists() else TRAIN[1:]
        if process.returncode:
            assert "File too large" in said or "cannot be written" in said, said
            where = () if len(again) == 1 else (f"hydra.run.dir={folder}",)
            lines_of(start("train.py", *again, *where))
        tables = [without_times(path / "progress.csv") for path in (tmp_path / "whole", folder)]
        assert tables[0] == tables[1]


@pytest.mark.parametrize("limits", ["ulimit -n 24;", "ulimit -v 3000000;", "ulimit -n 60;"])
def test_little_of_anything_ends_in_a_line_or_not_at_all(limits, tmp_path):
    process = start(*TRAIN, f"hydra.run.dir={tmp_path / 'run'}", limits=limits)
    said = said_by(process)
    if process.returncode == 0:
        assert read_table(tmp_path / "run" / "progress.csv")["steps"][-1] == 400
    else:
        assert len(said) < 5_000 or "import" in said, said
