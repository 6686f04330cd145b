"""Processes that end with their parent, however that was ended."""

import signal
import subprocess
import sys
import time

import pytest
from commands import ROOT

from safe_rl.collectors.workers import starting_processes

pytestmark = pytest.mark.long

# a parent that starts a child, which says when it watches and when it gets SIGTERM
PARENT = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", {child!r}])
time.sleep(600)
"""
CHILD = """
import os, signal, sys, time
from safe_rl.collectors.workers import end_with_parent
signal.signal(signal.SIGTERM, lambda *_: print("told", flush=True))
end_with_parent({grace})
end_with_parent({grace})
print(os.getpid(), flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize(
    ("grace", "ending", "last_words"), [(0.0, signal.SIGKILL, []), (3.0, signal.SIGTERM, ["told"])]
)
def test_a_child_ends_soon_after_its_parent(ending, grace, last_words):
    source = PARENT.format(child=CHILD.format(grace=grace))
    parent = subprocess.Popen(
        [sys.executable, "-c", source], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout.readline().strip().isdigit()
    parent.send_signal(ending)
    parent.wait()
    start = time.monotonic()
    # the pipe ends when the last process that writes into it has
    assert parent.stdout.read().split() == last_words
    assert time.monotonic() - start < 300


def test_a_child_whose_parent_has_already_ended_ends_too():
    gone = subprocess.Popen(["true"])
    gone.wait()
    source = f"from safe_rl.collectors.workers import *; end_with_parent(0.0, {gone.pid})"
    words = [sys.executable, "-c", f"{source}; time.sleep(300)"]
    child = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert (child.returncode, child.stderr) == (1, "")


DEAF = """
import sys, time
sys.stdin.readline()
from safe_rl.collectors.workers import leave_signals_to_parent
leave_signals_to_parent()
print("begun", flush=True)
time.sleep(600)
"""


def send_from_elsewhere(pid):
    for name in ("INT", "TERM", "HUP"):
        subprocess.run(["kill", f"-{name}", str(pid)], check=True)


def test_signals_pass_over_a_child_from_its_start_on_but_for_its_parents_order():
    heeded = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    with starting_processes():
        child = subprocess.Popen(
            [sys.executable, "-c", DEAF],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == heeded
    try:
        send_from_elsewhere(child.pid)
        child.stdin.write("\n")
        child.stdin.flush()
        assert child.stdout.readline() == "begun\n"
        send_from_elsewhere(child.pid)
        time.sleep(0.5)
        assert child.poll() is None
        child.terminate()
        assert child.wait(300) == 128 + signal.SIGTERM
    finally:
        child.kill()
        child.communicate()
