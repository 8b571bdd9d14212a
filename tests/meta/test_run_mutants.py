# SPDX-License-Identifier: MIT
"""The quick tier finds planted faults, with a user's default seed: some of each stage. ``make mutants`` tries all."""

import pytest

from conformance.mistakes import MISTAKES, find
from conformance.report.failures import keep_failure, replay
from stss.port import ReferencePort
from tests.meta.run_mutants import failed
from tests.tiers import thorough

STAGES = sorted({mutant.stage for mutant in MISTAKES})
SMALL = [mutant for mutant in MISTAKES if not mutant.large]
NAMES = [name for stage in STAGES for name in [mutant.id for mutant in SMALL if mutant.stage == stage][::-24]]
NAMES.append("frame_hole_test_ignored")  # the kept weights say which test
OFTEN = [name for name in NAMES[::3] if not name.startswith(("frame_", "network_"))]  # those take long


@pytest.mark.parametrize("name", [name if name in OFTEN else thorough(name) for name in NAMES])
def test_found_out(name, tmp_path):
    """The mutant fails again from the kept folder, while a mended port, the reference, passes."""
    (result,) = failed(name)
    folder = keep_failure(tmp_path, result.id, result.record.failure, "stss conform")
    assert replay(ReferencePort(), folder).failure is None
    assert replay(find(name).port(), folder).failure is not None


def test_a_kept_failure_replaces_one_of_an_earlier_run_alone(tmp_path, capsys):
    """A folder with a file of the user's, or of another name, is moved aside."""
    (result,) = failed(NAMES[0])

    def keep():
        return keep_failure(tmp_path, result.id, result.record.failure, "stss conform")

    place = keep()
    assert keep() == place
    assert [path.name for path in tmp_path.iterdir()] == [place.name]
    (place / "notes.txt").write_text("mine")
    keep()
    assert (tmp_path / f"{place.name}.1.aside" / "notes.txt").read_text() == "mine"
    assert not (place / "notes.txt").exists()
    assert "moved to" in capsys.readouterr().err
    place.rename(tmp_path / "elsewhere")
    place.symlink_to(tmp_path / "elsewhere")
    keep()
    assert (tmp_path / "elsewhere" / "README.txt").exists()
