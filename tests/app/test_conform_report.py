"""The page of ``stss conform --report`` in a browser."""

from types import SimpleNamespace

import pytest

from conformance.judging.findings import Record, TestResult
from conformance.report.report import write_page
from stss.images.read_write import write_rgb
from tests.app.test_pages import HOSTILE, pictures


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_report_on_a_port_has_the_style_of_the_pages(browser, tmp_path, width, scheme):
    """With a port's name and words of strangers, which stay text."""
    port = SimpleNamespace(name=f"port {HOSTILE}")
    judge = SimpleNamespace(
        port=port, arithmetic=SimpleNamespace(dtype="float32", winograd=False), tier=SimpleNamespace(name="quick"), seed=0
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
    browser.open(tmp_path / "p.html", width=width, scheme=scheme)
    assert browser.complaints() == []
    assert browser.unnamed() == []
    assert browser.do("document.documentElement.scrollWidth") <= width
    assert browser.do("document.scripts.length") == 0
    assert browser.do("document.images.length") == 1
    # What a test came to is in sight, however narrow the page; and the first lines lead to each failure.
    outcomes = browser.do("[...document.querySelectorAll('td.failed, td.passed')].map(e => e.getBoundingClientRect().right)")
    assert len(outcomes) == 2
    assert max(outcomes) <= width
    assert browser.do("document.querySelector('p a').hash") == "#rrm.one"
    assert browser.do("document.getElementById('rrm.one').tagName") == "H2"
    paper = browser.do("getComputedStyle(document.body).backgroundColor")
    assert paper == {"light": "rgb(255, 255, 255)", "dark": "rgb(13, 17, 23)"}[scheme]
    browser.screenshot(tmp_path / "shot.png")
