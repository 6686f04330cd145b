"""Full disks, few files, little memory: a run says so in a line, and is continued exactly."""

import resource
import shutil
import sys

from attacking import RUN, begin_or_continue, cases, exit_code_of, said_by, start
from run_configs import without_times

from safe_rl.runs.table import read_table
from safe_rl.training.train import is_expected

WORDS = (*RUN, "policy_update.minibatch_size=20", "frames=400", "certificate.episodes=0")
FULL = 3


def with_a_full_disk(kilobytes, folder):
    """Train where no file may have more bytes: writing them fails as on a full disk."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024 * kilobytes, resource.RLIM_INFINITY))
    try:
        begin_or_continue(folder, WORDS)
    except Exception as error:
        is_named = any(words in str(error) for words in ("File too large", "cannot be written"))
        if not (is_named and is_expected(error)):
            raise
        sys.exit(FULL)


def test_a_run_on_a_full_disk_is_continued_exactly(tmp_path):
    begin_or_continue(tmp_path / "whole", WORDS)
    expected = without_times(tmp_path / "whole" / "progress.csv")
    for random in cases("full disks", 40):
        folder = tmp_path / "full"
        code = exit_code_of(with_a_full_disk, random.randint(1, 40), folder)
        assert code in (0, FULL)
        if code:
            begin_or_continue(folder, WORDS)
        assert without_times(folder / "progress.csv") == expected
        shutil.rmtree(folder)


def test_little_of_anything_ends_in_a_line_or_not_at_all(tmp_path):
    all_limits = ["trap '' XFSZ; ulimit -f 20;", "ulimit -n 24;", "ulimit -v 3000000;"]
    for number, limits in enumerate([*all_limits, "ulimit -n 60;"]):
        folder = tmp_path / str(number)
        process = start("train.py", *WORDS, f"hydra.run.dir={folder}", limits=limits)
        said = said_by(process)
        assert "XFSZ" not in limits or "Traceback" not in said, said
        if process.returncode == 0:
            assert read_table(folder / "progress.csv")["steps"][-1] == 400
        else:
            assert len(said) < 5_000 or "import" in said, said
