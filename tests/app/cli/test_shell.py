"""Command lines as text, on this system and as on Windows."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from conformance.protocol.load_port import split_command
from stss_ground import shell
from stss_ground.option_kinds import Program

WORDS = st.lists(st.text(st.sampled_from("aZ0 -_=/.:$'"), min_size=1), min_size=1)


@pytest.fixture(params=["posix", "nt"])
def system(request, monkeypatch):
    monkeypatch.setattr(shell, "os", SimpleNamespace(name=request.param))
    return request.param


@given(WORDS, st.sampled_from(["C:\\port\\d.exe", "C:\\Program Files\\d.exe", "\\\\server\\share\\d.exe", "./port"]))
def test_words_that_are_joined_are_taken_apart(words, program):
    for name in ("posix", "nt"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(shell, "os", SimpleNamespace(name=name))
            assert shell.split_words(shell.join_words([program, *words])) == [program, *words]


@pytest.mark.parametrize(("line", "words"), [
    (r"build\port.exe --gpu 1", [r"build\port.exe", "--gpu", "1"]),
    (r'"C:\Program Files\port.exe" --out=C:\a # b', [r"C:\Program Files\port.exe", r"--out=C:\a", "#", "b"]),
    (r"C:\it's\port.exe", [r"C:\it's\port.exe"]),
])  # fmt: skip
def test_a_backslash_is_a_letter_on_windows_alone(monkeypatch, line, words):
    monkeypatch.setattr(shell, "os", SimpleNamespace(name="nt"))
    assert shell.split_words(line) == words
    monkeypatch.setattr(shell, "os", SimpleNamespace(name="posix"))
    assert shell.split_words("'my port' a\\ b") == ["my port", "a b"]


def test_an_open_quote_is_told(system):
    with pytest.raises(ValueError, match="quot"):
        shell.split_words('"a b')


def test_the_program_of_a_port_keeps_its_path(monkeypatch):
    assert Path("my port") in Program().reads("'my port' --table=t.csv")
    monkeypatch.setattr(shell, "os", SimpleNamespace(name="nt"))
    assert split_command(r"build\port.exe --gpu 1") == [r"build\port.exe", "--gpu", "1"]
    assert Path(r"build\port.exe") in Program().reads(r"build\port.exe --gpu 1")
