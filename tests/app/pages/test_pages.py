"""Pages: their content, and their behaviour in a browser."""

import hashlib
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss.images.read_write import write_mask, write_rgb
from stss.pages.viewer import Pane, ShownFrame, Viewer, write_viewer
from stss_ground.pages.page import asset, page, table
from stss_ground.pages.plot import PlotLine, plot

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>&\"'`${1}\u202e\n\x1b"
SIZE = (24, 40)


def pictures(seed, *names):
    rng = np.random.default_rng(seed)
    return {name: rng.random((*SIZE, 3), dtype=np.float32) for name in names}


def viewer(names=("output", "truth"), title="a page"):
    lines = [
        PlotLine("SF", {0: 30.0, 2: 31.0}, "SF", 0),
        PlotLine("EF", {1: 28.0, 3: float("inf")}, "EF", 1),
    ]
    views = [Pane(name, f"what {name} is") for name in names]
    return Viewer(
        title, ["a note"], views, (names[0], names[-1]), [plot("PSNR, dB", lines, digits=2)], [table("T", ["a"], [["1"]])]
    )


def frames(count=4, names=("output", "truth")):
    return [ShownFrame(n, "EF" if n % 2 else "SF", f"{30 + n} dB", pictures(n, *names)) for n in range(count)]


def data_of(path):
    return json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(), re.DOTALL)[1])


def tags(text):
    problems = []
    parser = HTMLParser()
    parser.handle_starttag = lambda tag, attributes: problems.append((tag, dict(attributes)))
    parser.feed(text)
    return problems


def test_the_slider_is_the_one_that_was_published():
    digest = hashlib.sha256(asset("stss.pages", "vendor/image-compare.min.js").encode()).hexdigest()
    assert f"`{digest}`" in asset("stss.pages", "vendor/README.md")
    assert "MIT License" in asset("stss.pages", "vendor/image-compare.LICENSE")


def test_text_of_strangers_stays_text(tmp_path):
    named = ("output", HOSTILE)
    page = viewer(named, HOSTILE)
    page = Viewer(**{**vars(page), "notes": [HOSTILE], "tables": [table(HOSTILE, [HOSTILE], [[HOSTILE]])]})
    write_viewer(tmp_path / "p.html", page, [ShownFrame(1, "", HOSTILE, pictures(1, *named))])
    plain = tmp_path / "plain.html"
    write_viewer(plain, viewer(), frames(1))
    text = (tmp_path / "p.html").read_text()
    assert not [tag for tag, attributes in tags(text) if "onerror" in attributes]
    assert [tag for tag, _ in tags(text)].count("script") == [tag for tag, _ in tags(plain.read_text())].count("script") == 3
    assert data_of(tmp_path / "p.html")["frames"][0]["caption"].endswith(HOSTILE)
    for tag, attributes in tags(text):
        for name in ("src", "href"):
            assert attributes.get(name, "#").startswith(("#", "data:")), (tag, attributes)


def test_pictures_beyond_the_size_lie_beside_and_go_with_their_page(tmp_path):
    path = tmp_path / "a page & more.html"
    write_viewer(path, viewer(), frames(), within=5000)
    places = data_of(path)["pictures"]
    outside = [place for place in places if not place.startswith("data:")]
    assert outside
    assert len(outside) < len(places)
    folder = tmp_path / "a page & more_files"
    assert outside[0].startswith("a%20page%20%26%20more_files/")
    assert sorted(p.name for p in folder.glob("*.png")) == sorted(place.split("/")[1] for place in outside)
    write_viewer(path, viewer(), frames(), within=1 << 20)
    assert not list(folder.glob("*.png"))


def test_a_plot_has_sf_and_ef_apart_and_a_way_to_every_frame():
    svg = plot("PSNR, dB", [PlotLine("SF", {0: 30.0, 2: 31.0}, "SF", 0), PlotLine("EF", {1: 28.25}, "EF", 1)], digits=2)
    links = [attributes for tag, attributes in tags(svg) if tag == "a"]
    assert [link["href"] for link in links] == ["#frame-0", "#frame-2", "#frame-1"]
    assert links[2]["aria-label"] == "frame 1, EF: 28.25"
    assert [tag for tag, _ in tags(svg)].count("rect") == 1
    places = re.findall(r'class="hit" cx="[\d.]+" cy="([\d.]+)"', svg)
    heights = {link["aria-label"]: float(y) for link, y in zip(links, places, strict=True)}
    assert heights["frame 2, SF: 31.00"] < heights["frame 0, SF: 30.00"] < heights["frame 1, EF: 28.25"]


@pytest.mark.parametrize("values", [[5.0, 5.0], [float("inf")], [-3.0, 2000.0]])
def test_a_plot_of_any_numbers_stays_within_its_frame(values):
    svg = plot("x", [PlotLine("SF", dict(enumerate(values)), "SF", 0)], digits=2)
    assert "nan" not in svg
    for y in re.findall(r' cy="([-\d.]+)"', svg):
        assert 0 <= float(y) <= 240


@pytest.fixture
def comparison(tmp_path):
    """Two folders of an output and its truth, four frames."""
    for n in range(4):
        truth = pictures(n, "truth")["truth"]
        labels = {"stss:kind": "EF" if n % 2 else "SF", "stss:transfer": "none", "stss:method": "network"}
        for folder, image in (("out", np.clip(truth + 0.1, 0, 1)), ("truth", truth)):
            (tmp_path / folder).mkdir(exist_ok=True)
            write_rgb(tmp_path / folder / f"frame.{n:04d}.png", image, metadata=labels if folder == "out" else None)
        if n % 2:
            (tmp_path / "out" / "holes").mkdir(exist_ok=True)
            write_mask(tmp_path / "out" / "holes" / f"frame.{n:04d}.png", np.ones((SIZE[0] // 2, SIZE[1] // 2), np.bool_))
    return tmp_path


def test_compare_makes_a_page(comparison):
    words = ["compare", str(comparison / "out"), str(comparison / "truth"), "--html", str(comparison / "p.html")]
    result = CliRunner().invoke(stss, words, catch_exceptions=False)
    assert result.exit_code == 0
    data = data_of(comparison / "p.html")
    assert data["views"] == ["output", "truth"]
    assert len(data["pictures"]) == 8
    assert [frame["name"] for frame in data["frames"]] == ["frame 0, SF", "frame 1, EF", "frame 2, SF", "frame 3, EF"]
    text = (comparison / "p.html").read_text()
    for title in ("PSNR over RGB, dB", "SSIM of the luma", "What the columns mean"):
        assert title in text
    assert text.count("<svg viewBox") == 3


def test_compare_shows_what_the_output_was_made_of(comparison, write_frames):
    folder = write_frames(range(4), rendered={0, 2}, size=(SIZE[0] // 2, SIZE[1] // 2))
    words = ["compare", str(comparison / "out"), str(comparison / "truth"), "--sequence", str(folder)]
    result = CliRunner().invoke(stss, [*words, "--html", str(comparison / "p.html")], catch_exceptions=False)
    assert result.exit_code == 0
    data = data_of(comparison / "p.html")
    assert data["views"] == ["input", "bilinear", "output", "truth"]
    inputs = [frame["pictures"]["input"] for frame in data["frames"]]
    assert inputs[0] == inputs[1] != inputs[2] == inputs[3]


def test_a_page_forbids_what_is_not_its_own():
    text = page("t", "<p>b</p>", scripts=[asset("stss.pages", "viewer.js")])
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert policy.startswith("default-src 'none';")
    assert "'unsafe-inline'" not in policy.split("script-src")[1]


# What follows needs a browser: Debian's chromium, or Chrome.


@pytest.fixture(scope="module")
def page_path(tmp_path_factory):
    """A page whose last pictures lie beside it."""
    path = tmp_path_factory.mktemp("page") / "p.html"
    names = ("input", "bilinear", "output", "truth")
    write_viewer(path, viewer(names), frames(4, names), within=40_000)
    assert any(not place.startswith("data:") for place in data_of(path)["pictures"])
    return path


def test_a_page_opens_from_disk_and_fits_a_telephone(ask, page_path):
    """Every picture of every frame in every mode is there, nothing is asked of a network, and nothing is cut off."""
    script = """
        let there = true;
        for (const mode of "sfdp") for (let i = 0; i < 4; i++) {
            press(mode);
            press(i ? "." : "Home");
            await Promise.all([...page.images].map((i) => i.complete || new Promise((done) => (i.onload = i.onerror = done))));
            there &&= page.images.length > 0 && [...page.images].every((image) => image.naturalWidth > 0);
        }
        const asked = view.performance.getEntriesByType("resource").map((entry) => entry.name);
        const named = [...page.querySelectorAll("button, select, input")].every((e) => e.labels?.length || e.ariaLabel || e.textContent);
        page.querySelector('.point[data-frame="3"]').dispatchEvent(new view.MouseEvent("click", { bubbles: true }));
        await new Promise((done) => setTimeout(done, 100));
        const elsewhere = asked.filter((name) => !/^(file|data):/.test(name));
        return [there, elsewhere, named, text("#caption"), page.documentElement.scrollWidth];
    """
    *lines, wide = ask(page_path, script, 390)
    assert lines == [True, [], True, "frame 3, EF: 33 dB"]  # the point of the plot led to its frame
    assert wide <= 390


def test_keys_lead_through_frames_views_and_zoom(ask, page_path):
    lines = ask(
        page_path,
        """
        const said = [text("#caption")];
        press("."); press(".");
        said.push(text("#caption"));
        press("ArrowLeft");
        said.push(text("#caption"), page.querySelector(".strip [aria-current=true]").hash);
        press("d");
        said.push(view.getComputedStyle(page.querySelector(".frame.difference img + img")).mixBlendMode, text(".tag"));
        press("g");
        said.push(view.getComputedStyle(page.querySelector(".frame.difference")).filter);
        press("b");
        said.push(text(".tag"));
        press("p"); press("+");
        const scales = new Set([...page.querySelectorAll("#stage img")].map((i) => view.getComputedStyle(i).transform));
        said.push(scales.size, text("#zoomed"));
        return said;
        """,
    )
    assert lines == [
        "frame 0, SF: 30 dB",
        "frame 2, SF: 32 dB",
        "frame 1, EF: 31 dB",
        "#frame-1",
        "difference",
        "difference of input and truth",
        "brightness(8)",
        "difference of input and input",
        1,
        "2x",
    ]
