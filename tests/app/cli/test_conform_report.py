"""The page of ``stss conform --report`` in a browser."""

from types import SimpleNamespace

from conformance.judging.findings import Record, TestResult
from conformance.report.report import write_page
from stss.images.read_write import write_rgb
from tests.app.pages.test_pages import HOSTILE, pictures


def test_the_report_on_a_port_is_a_page_like_the_others(ask, tmp_path):
    """With a stranger's words as the port's name and messages, which stay text."""
    port = SimpleNamespace(name=f"port {HOSTILE}")
    judge = SimpleNamespace(
        port=port,
        arithmetic=SimpleNamespace(dtype="float32", winograd=False),
        tier=SimpleNamespace(name="quick"),
        seed=0,
        weights_version=3,
        largest_side=None,
    )
    folder = tmp_path / "rrm.one"
    folder.mkdir()
    (folder / "README.txt").write_text(f"{'word ' * 60}{HOSTILE}\n\n  stss conform --replay {'x' * 300}\n")
    write_rgb(folder / "picture.png", pictures(0, "a")["a"])
    wrong = TestResult(
        "rrm.one", "rrm", "It holds.", "failed", HOSTILE, record=Record(cases=7, worst={"rrm.valid": float("inf")})
    )
    right = TestResult("warp.a_test_with_a_long_name_that_goes_on", "warp", "Words. " * 30, "passed", record=Record(cases=9))
    write_page(tmp_path / "p.html", judge, [wrong, right], {"rrm.one": folder})
    script = """
        const right = [...page.querySelectorAll("td.failed, td.passed")].map((e) => e.getBoundingClientRect().right);
        const failure = page.querySelector("p a").hash;
        return [page.documentElement.scrollWidth, right, page.scripts.length, page.images.length, failure, page.querySelector(
            `[id="${failure.slice(1)}"]`).tagName];
    """
    wide, outcomes, *rest = ask(tmp_path / "p.html", script, 390)
    # The outcome of a test is visible on a page of any width, and the first lines lead to each failure.
    assert wide <= 390
    assert len(outcomes) == 2
    assert max(outcomes) <= 390
    assert rest == [0, 1, "#rrm.one", "H2"]
