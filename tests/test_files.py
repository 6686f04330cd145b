"""Configurations of strangers, files that are written in one go, and folders that vanish."""

import gzip
import os

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from safe_rl import files
from safe_rl.files import read_config, read_json, read_yaml, replacing
from safe_rl.reporting import archive
from safe_rl.runs import table
from safe_rl.runs.folder import paths_below
from safe_rl.runs.run import Run, find_runs

NUMBERS = st.booleans() | st.integers() | st.floats(allow_nan=False)
VALUES = st.recursive(
    st.none() | NUMBERS | st.text("abe -+:#'10_."),
    lambda inner: st.lists(inner) | st.dictionaries(st.text("abc", min_size=1), inner),
)


@settings(max_examples=25)
@given(config=st.dictionaries(st.text("abc", min_size=1), VALUES))
def test_what_a_run_saves_is_read_back(config, tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "config.yaml"
    OmegaConf.save(OmegaConf.create(config), path)
    assert read_config(path) == config


BOMB = "a: &a [x, x]\n" + "".join(
    f"{n}: &{n} [*{m}, *{m}]\n" for m, n in zip("abc", "bcd", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: ${oc.env:HOME}", "interpolations"),
        ("a: {b: [1, 'x${a}']}", "interpolations"),
        ("- a", "mapping"),
        ('a: "\\e[2Jgone"', "control characters"),
        ("1: a", "mapping"),
        ("{", "cannot be read"),
        ("a: !!python/object/apply:os.system [true]", "cannot be read"),
        ("a: ${", "interpolations"),
        ("a: !!bool perhaps", "cannot be read"),
        ("[a]: b", "cannot be read"),
        (BOMB, "aliases"),
        ("[" * 5000, "more than 100 levels|increasing flow level"),
        ("a: " + "x" * 1_000_001, "more than 1,000,000 bytes"),
        (b"\xff\xfe\x00", "cannot be read"),
    ],
)
def test_what_is_no_resolved_configuration_is_refused(text, message, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message):
        read_config(path)


def test_what_is_not_resolved_can_be_read_and_stays_so(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "hush")
    path = tmp_path / "hydra.yaml"
    path.write_text("a: [1e-4, '${oc.env:SECRET}', '???']")
    assert read_yaml(path) == {"a": [1e-4, "${oc.env:SECRET}", "???"]}


@pytest.mark.parametrize(
    "value",
    [
        "[1_000, 1e-4, 1e4, -2.5E+3, 1.5e3, 1_0e2, .5, +.5, .5e3, .inf, .nan, 8_e4, e4, 1e, 08]",
        "[0x1f, 1:30, yes, null, ~]",
        "???",
    ],
)
def test_values_are_read_as_omegaconf_reads_them(value, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(f"key: \n  {value}")
    assert repr(read_yaml(path)) == repr(OmegaConf.to_container(OmegaConf.load(path)))


def test_a_file_is_replaced_when_it_is_complete(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("before")
    with replacing(path) as unfinished:
        unfinished.write_text("aft")
        assert path.read_text() == "before"
    assert path.read_text() == "aft"
    with pytest.raises(UnicodeEncodeError), replacing(path) as unfinished:
        unfinished.write_text("half \udc80")
    assert [file.name for file in tmp_path.iterdir()] == ["table.csv"]
    assert path.read_text() == "aft"


@pytest.mark.parametrize("text", ["[" * 200_000, "- " * 200_000, "{a: " * 900, "x" * 2_000_000])
@pytest.mark.parametrize("reader", [read_yaml, read_json])
def test_what_is_too_deep_or_too_large_is_refused_before_it_is_parsed(reader, text, tmp_path):
    """The C parser of YAML overflows the stack at some ten thousand levels."""
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"config\.yaml cannot be read"):
        reader(path)


def test_a_table_of_any_size_and_a_pipe_are_not_read(tmp_path):
    sparse = tmp_path / "progress.csv"
    with sparse.open("wb") as file:
        file.truncate(3_000_000_000)
    with pytest.raises(ValueError, match="more than 100,000,000 bytes"):
        table.read_table(sparse)
    with pytest.raises(ValueError, match="more than 100,000,000 bytes"):
        _ = Run(tmp_path).num_rows
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe is no regular file"):
        files.read_bounded(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe is no regular file"):
        files.check_no_links(tmp_path)


def test_what_unpacks_to_more_than_an_archive_has_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "_MOST_BYTES", 2_000_000)
    with gzip.open(tmp_path / "runs.json.gz", "wb") as file:
        file.write(b" " * 3_000_000)
    with pytest.raises(ValueError, match="more than 2,000,000 bytes"):
        archive.read_archive(tmp_path)


def test_a_table_of_more_columns_than_a_run_has_is_refused(tmp_path):
    path = tmp_path / "progress.csv"
    path.write_text("\n".join(",".join(map(str, range(100_000))) for _ in range(2)) + "\n")
    with pytest.raises(ValueError, match="100,000 columns"):
        table.read_table(path)


def test_runs_are_found_while_folders_of_a_checkpoint_come_and_go(tmp_path, monkeypatch):
    for run in ("b", "a"):
        (tmp_path / run / "checkpoints" / ".stage").mkdir(parents=True)
        (tmp_path / run / "config.yaml").touch()
    list_folder = os.scandir

    def vanish(path):
        if os.path.basename(path) == ".stage":
            raise FileNotFoundError(path)
        return list_folder(path)

    monkeypatch.setattr(os, "scandir", vanish)
    assert [run.directory.name for run in find_runs(tmp_path)] == ["a", "b"]
    assert paths_below(tmp_path, "*.mp4") == []


def test_a_hint_does_not_search_a_whole_disk(tmp_path, monkeypatch):
    for number in range(1_100):
        (tmp_path / "a" / str(number)).mkdir(parents=True)
    list_folder, seen = os.scandir, []
    monkeypatch.setattr(os, "scandir", lambda path: (seen.append(path), list_folder(path))[1])
    with pytest.raises(FileNotFoundError, match="not the folder of a run"):
        Run(tmp_path).check_is_run()
    assert len(seen) <= 1_001
    assert len(paths_below(tmp_path, "*")) == 1_101


def test_tensors_of_a_device_that_is_missing_here_are_read_into_main_memory(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("torch.serialization.location_tag", lambda storage: "cuda:1")
        files.save_tensors(tmp_path / "state.pt", {"x": torch.ones(2)})
    for name, value in (("is_available", True), ("device_count", 1)):
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    assert files.load_tensors(tmp_path / "state.pt")["x"].device.type == "cpu"
