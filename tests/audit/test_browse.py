"""The page in a real browser: what it shows is what the data say, by mouse and by keyboard."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.schema.parse import parse_scene_key
from tests.audit.browsing import run, serving
from tests.audit.corruption import rewrite_depth
from tests.servers.tools import chromium, require_module, wait_until
from tests.shards.shard_files import scenes_of

# The index names a scene that was left out, each time that it is opened.
pytestmark = pytest.mark.filterwarnings(
    "ignore::stereogenbench_data.index.table.IncompleteSceneWarning"
)

FLAGS = (
    "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--window-size=1400,900",
)  # fmt: skip
COPIES = 40
"""Each of the four scenes is listed so often, so that the list has to be scrolled."""


def unmeasured_corner(units):
    units = units.copy()
    units[:, :6, :6] = 0
    return units


@pytest.fixture(scope="module")
def data(small_release, tmp_path_factory):
    """A tree with an index of many scenes: the same videos under other keys, and a broken one."""
    root = tmp_path_factory.mktemp("many") / "data"
    shutil.copytree(small_release, root)
    rewrite_depth(root / "train/Uniform/SynthStage/scene_000001", unmeasured_corner)
    scenes = []
    for row, scene in enumerate(scenes_of(root).values()):
        for copy in range(COPIES):
            key = f"{scene.id.key.rpartition('/')[0]}/scene_{row * COPIES + copy:06d}"
            scenes.append(replace(scene, id=parse_scene_key(key)))
    lost = replace(scenes[-1].members["cam_01_depth.mkv"], path="lost.mkv")
    members = dict(scenes[-1].members) | {"cam_01_depth.mkv": lost}
    scenes[-1] = replace(scenes[-1], members=members)
    many = SceneIndex.from_scenes(scenes, root)
    many.broken = {"train/Uniform/SynthStage/scene_000999": "cam_00_rgb.mp4: has 6 frames"}
    many.write(root / "index.parquet")
    return root


@pytest.fixture(scope="module")
def address(data):
    with pytest.warns(UserWarning, match="scene_000999"):
        index = SceneIndex.open(data)
    with serving(index, data) as server:
        yield server.url


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    profile = f"--user-data-dir={tmp_path_factory.mktemp('profile')}"
    with chromium(*FLAGS, profile) as driver:
        yield driver


class Page:
    """The open page, as a user sees it."""

    def __init__(self, browser, address):
        self.browser = browser
        self.address = address

    def open(self, place=""):
        self.browser.get("about:blank")
        self.browser.get(f"{self.address}#{place}")
        wait_until(lambda: self.script("return document.body.dataset.ready") == "yes")
        self.settle()

    def script(self, code, *values):
        return self.browser.execute_script(code, *values)

    def text(self, name):
        return self.script("return document.getElementById(arguments[0]).textContent", name)

    def settle(self):
        """Wait until the line of the sample is that of the pair and the frame that are shown."""
        wait_until(lambda: self.frame() in self.text("sample-line") and self.text("readout"))

    def frame(self):
        return f"frames={self.text('frame-number').partition(' /')[0]})"

    def press(self, *keys):
        for key in keys:
            self.browser.switch_to.active_element.send_keys(key)

    def filter(self, name, value):
        before = self.text("selection-line")
        self.script(
            "document.querySelector(`#facet-${arguments[0]} [value='${arguments[1]}']`).click()",
            name, value,
        )  # fmt: skip
        wait_until(lambda: self.text("selection-line") != before)

    def type(self, name, value):
        """Write into a field of the filters."""
        self.script(
            "document.getElementById(arguments[0]).value = arguments[1];"
            "document.getElementById('filters').dispatchEvent(new Event('input'));",
            name, value,
        )  # fmt: skip

    def hash(self):
        return self.script("return location.hash.slice(1)")

    def box(self, place):
        """Return left, top, right and bottom of an element."""
        return self.script(
            "const box = document.querySelector(arguments[0]).getBoundingClientRect();"
            "return [box.left, box.top, box.right, box.bottom];", place,
        )  # fmt: skip

    def point(self, pane, x, y):
        """Move the mouse to the middle of a picture's pixel."""
        self.script(
            "const box = document.querySelector(`[data-pane=${arguments[0]}] canvas`);"
            "const at = box.getBoundingClientRect();"
            "box.dispatchEvent(new PointerEvent('pointermove', {bubbles: true,"
            " clientX: at.left + (arguments[1] + 0.5) * at.width / box.width,"
            " clientY: at.top + (arguments[2] + 0.5) * at.height / box.height}));",
            pane, x, y,
        )  # fmt: skip


@pytest.fixture
def page(browser, address):
    page = Page(browser, address)
    page.open()
    return page


def keys_listed(page):
    return page.script(
        "return [...document.querySelectorAll('.row')].map((row) => row.title).sort()"
    )


def test_the_numbers_under_the_cursor_are_those_of_the_maps(page):
    page.open("key=train/Uniform/SynthStage/scene_000120&pair=0-2&frame=3")
    sample = run(page.text("sample-line"))["sample"]

    assert sample["__key__"] == "train/Uniform/SynthStage/scene_000120/00-02/003"
    whole = StereoPairs(
        run(page.text("selection-line"))["pairs"].index, scenes=sample["scene"], pairs=[(0, 2)],
        frames=3, fields=("disparity", "depth", "valid", "visible"),
    )[0]  # fmt: skip
    measured = whole["valid"][0].nonzero().tolist()
    for pane, (y, x) in (
        ("disparity", measured[5]),
        ("left", measured[-1]),
        ("depth", measured[9]),
    ):
        page.point(pane, x, y)

        assert page.text("at") == f"x {x}, y {y}"
        assert page.text("disparity-here") == f"{float(whole['disparity'][0, y, x]):.3f} px"
        assert page.text("depth-here") == f"{float(whole['depth'][0, y, x]):.3f} m"
        seen = bool(whole["visible"][0, y, x])
        assert page.text("seen-here").startswith("visible" if seen else "hidden")
    y, x = (~whole["valid"][0]).nonzero().tolist()[0]
    page.point("left", x, y)
    assert page.text("disparity-here") == "not measured"


def test_pictures_and_maps_are_drawn_as_they_are(page):
    page.open("key=train/Uniform/SynthStage/scene_000120&pair=0-2&frame=3")
    sample = run(page.text("sample-line"))["sample"]

    def drawn(pane):
        flat = page.script(
            "const box = document.querySelector(`[data-pane=${arguments[0]}] canvas`);"
            "return [...box.getContext('2d').getImageData(0, 0, box.width, box.height).data]",
            pane,
        )
        return np.array(flat).reshape(64, 64, 4)[..., :3]

    left, right = (sample[name].numpy().transpose(1, 2, 0) for name in ("left", "right"))
    assert np.abs(drawn("left") - left).mean() < 3
    assert np.abs(drawn("right") - right).mean() < 3
    wanted = np.stack([left[..., 0], right[..., 1], right[..., 2]], axis=-1)
    assert np.abs(drawn("anaglyph") - wanted).mean() < 3
    from stereogenbench_data.bridges.picture import ColourScale

    disparity, valid = sample["disparity"][0].numpy(), sample["valid"][0].numpy()
    painted = ColourScale.of(disparity, measured=valid).paint(disparity, measured=valid)
    assert np.abs(drawn("disparity") - painted.astype(int)).mean() < 4


def test_the_keyboard_alone_flips_frames_pairs_scenes_and_views(page):
    arrows = require_module("selenium.webdriver.common.keys").Keys

    page.press(arrows.ARROW_RIGHT, arrows.ARROW_RIGHT)
    wait_until(lambda: page.text("frame-number") == "2 / 6")
    page.press(arrows.END)
    wait_until(lambda: page.text("frame-number") == "6 / 6")
    page.press(arrows.ARROW_RIGHT, arrows.HOME, arrows.ARROW_RIGHT)
    wait_until(lambda: page.text("frame-number") == "1 / 6")
    first = page.script("return document.querySelector('.pair[aria-checked=true] b').textContent")
    page.press(arrows.ARROW_DOWN)
    shown = "return document.querySelector('.pair[aria-checked=true] b').textContent"
    wait_until(lambda: page.script(shown) != first)
    before = page.text("key")
    page.press("j")
    wait_until(lambda: page.text("key") != before)
    page.press("k")
    wait_until(lambda: page.text("key") == before)
    page.press("4")
    panes = "return [...document.querySelectorAll('[data-pane]')].map((box) => box.dataset.pane)"
    wait_until(lambda: page.script(panes) == ["disparity"])
    page.press("d")
    wait_until(lambda: page.text("at") == "x 33, y 32")
    page.press("8")
    wait_until(lambda: page.script(panes) == ["wiggle"])
    caption = "return document.querySelector('.pane figcaption').textContent"
    wait_until(lambda: "right" in page.script(caption))
    wait_until(lambda: "left" in page.script(caption))
    page.press("/")
    assert page.script("return document.activeElement.id") == "caption"


def test_the_list_holds_few_rows_and_scrolls_to_any(page):
    assert len(keys_listed(page)) < 60

    page.script("document.getElementById('list').scrollTop = 1e6")
    wait_until(lambda: "train/Uniform/SynthStage/scene_000159" in keys_listed(page))
    assert len(keys_listed(page)) < 60


def test_a_broken_scene_is_named_and_what_can_be_read_is_shown(page):
    page.open("key=train/Uniform/SynthStage/scene_000159&pair=1-3")
    shown = page.script(
        "return [...document.querySelectorAll('.picture')].map((box) =>"
        " [box.dataset.pane, !box.classList.contains('empty')])"
    )

    assert "scene_000159" in page.text("error")
    assert "lost.mkv: cannot be read" in page.text("error")
    assert dict(shown) == {
        "left": True, "right": True, "disparity": False, "depth": False, "visible": False,
        "anaglyph": True,
    }  # fmt: skip
    assert page.text("left-out") == "1 scene left out"
    assert "scene_000999: cam_00_rgb.mp4: has 6 frames" in page.text("left-out-list")


def reset(page):
    page.script("document.getElementById('reset-all').click()")
    wait_until(lambda: page.text("count") == "160 scenes, 2,400 pairs")


def visible(page, *places):
    """Return which of some elements a user sees, by their selectors."""
    return [
        page.script(
            "const box = document.querySelector(arguments[0]);"
            "return box.checkVisibility({visibilityProperty: true})"
            " && box.getBoundingClientRect().width > 0",
            place,
        )
        for place in places
    ]


def test_where_nothing_is_left_nothing_stale_is_shown_and_a_button_resets(page):
    before = page.text("key")
    page.type("caption", "zebra at night")
    wait_until(lambda: page.text("count") == "0 scenes, 0 pairs")

    assert visible(page, "#nothing", "#reset-all", "#stage", ".heading", "#pairs", ".code") == [
        True, True, False, False, False, False,
    ]  # fmt: skip
    assert "none with all of zebra, at, night" in page.text("nothing-reason")
    assert keys_listed(page) == []
    wait_until(lambda: "caption=zebra+at+night" in page.hash())
    assert "key=" not in page.hash()

    reset(page)
    wait_until(lambda: visible(page, "#stage", "#nothing") == [True, False])
    assert page.text("key") == before
    assert page.script("return document.getElementById('caption').value") == ""


def test_the_address_is_a_link_to_filters_sample_and_view(page):
    page.filter("split", "train")
    page.filter("family", "Uniform")
    assert page.text("count") == "80 scenes, 1,200 pairs"
    assert page.text("facet-family") == "IPD_Gaussian40Uniform80"
    pairs = run(page.text("selection-line"))["pairs"]
    assert (len(pairs.plan.scene_rows), len(pairs.plan.pairs)) == (80, 1200)
    page.type("baseline-low", "10")
    wait_until(lambda: "baseline_cm=(10, " in page.text("selection-line"))
    wait_until(lambda: page.text("key") in page.text("sample-line"))
    first = page.text("key")
    page.press("j", "4")
    wait_until(lambda: page.text("key") != first)
    wait_until(lambda: page.text("key") in page.text("sample-line"))
    wait_until(lambda: f"key={page.text('key')}&pair=" in page.hash())
    wait_until(lambda: "view=disparity" in page.hash())
    link = page.hash()
    names = ("key", "count", "selection-line", "sample-line", "frame-number")
    told = {name: page.text(name) for name in names}

    def paste(link):
        page.script("location.hash = arguments[0]", link)
        wait_until(lambda: page.text("count") == told["count"])
        wait_until(lambda: page.text("sample-line") == told["sample-line"])

    for follow in (page.open, paste):
        page.open()
        assert page.text("count") == "160 scenes, 2,400 pairs"
        follow(link)

        assert {name: page.text(name) for name in names} == told
        assert page.script("return document.getElementById('baseline-low').value") == "10"
        assert page.script(
            "return [...document.querySelectorAll('.facet :checked')].map((box) => box.value)"
        ) == ["train", "Uniform"]
        assert page.script("return document.querySelectorAll('[data-pane]').length") == 1
        assert page.hash() == link


def test_a_link_to_a_scene_that_is_not_there_says_so(page):
    page.open("key=train/Uniform/SynthStage/scene_777777")

    assert "'train/Uniform/SynthStage/scene_777777' is not a key of 160 scenes" in page.text(
        "notice"
    )
    assert visible(page, "#notice", "#stage") == [True, True]
    shown = page.text("key")
    page.script("location.hash = 'key=train/Nowhere/scene_000001'")
    wait_until(lambda: "train/Nowhere" in page.text("notice"))
    page.settle()
    assert page.text("key") == shown

    page.press("j")
    wait_until(lambda: not visible(page, "#notice")[0])


@pytest.fixture
def screen(page):
    """Return a function that gives the page a screen: its width, its scheme, touch on a phone."""
    tell = page.browser.execute_cdp_cmd

    def open_on(width, scheme):
        is_phone = width < 700
        size = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": is_phone}
        tell("Emulation.setDeviceMetricsOverride", size)
        tell("Emulation.setTouchEmulationEnabled", {"enabled": is_phone})
        scheme = {"name": "prefers-color-scheme", "value": scheme}
        tell("Emulation.setEmulatedMedia", {"features": [scheme]})
        page.open()
        return page

    yield open_on
    tell("Emulation.clearDeviceMetricsOverride", {})
    tell("Emulation.setTouchEmulationEnabled", {"enabled": False})
    tell("Emulation.setEmulatedMedia", {"features": []})


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (800, "light"), (1440, "dark")])
def test_a_screen_shows_pictures_first_their_numbers_beside_and_nothing_beyond_the_edge(
    screen, width, scheme
):
    page = screen(width, scheme)
    beyond = page.script("return document.documentElement.scrollWidth - innerWidth")
    left, right, readout = map(
        page.box, ("[data-pane=left] canvas", "[data-pane=right] canvas", "#readout")
    )

    assert beyond <= 0
    assert left[0] >= 0
    assert right[2] <= width
    assert right[3] <= 844
    if width == 390:
        assert left[2] - left[0] > 150
        assert left[3] < page.box("#pairs")[1] < page.box(".heading")[1]
        assert visible(page, "#open-drawer", "#drawer", "#steps") == [True, False, True]
        assert visible(page, "#help-button .for-touch", "#help-button .for-keys") == [True, False]
    else:
        assert readout[3] <= 844
        assert visible(page, "#open-drawer", "#drawer", "#steps") == [False, True, False]


def test_the_page_runs_without_a_word_on_the_console_and_loads_from_itself_alone(page, address):
    page.browser.get_log("browser")  # what was said before
    page.open()
    page.press("2")
    page.settle()
    loaded = page.script("return performance.getEntriesByType('resource').map((each) => each.name)")
    said = [
        entry["message"]
        for entry in page.browser.get_log("browser")
        if entry["level"] == "SEVERE" and "422" not in entry["message"]
    ]

    assert loaded
    assert all(name.startswith(address) for name in loaded)
    assert said == []
