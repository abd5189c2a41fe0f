"""The page's server: what it gives, and what it refuses."""

import http.client
import io
import json
import re
import socket
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from urllib.parse import urlencode

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data import SceneIndex, StereoPairs
from stereogenbench_data.audit.browser.server import STATIC
from tests.audit.browsing import serving

SCENE = "train/Uniform/SynthStage/scene_000001"
MOMENT = urlencode({"key": SCENE, "left": 0, "right": 3, "frame": 2})


@pytest.fixture(scope="module")
def server(indexed_release):
    index = SceneIndex.open(indexed_release)
    with serving(index, indexed_release) as server:
        yield server


def ask(server, path, *, method="GET", headers=None, body=None):
    port = server.server_address[1]
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    try:
        connection.putrequest(method, path, skip_host=True)
        for name, value in ({"Host": f"127.0.0.1:{port}"} | (headers or {})).items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.getheaders())
    finally:
        connection.close()


def test_the_page_is_shipped_whole_and_loads_nothing_from_elsewhere(server):
    folder = resources.files("stereogenbench_data.audit.browser") / "static"

    kinds = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg"}
    for file in folder.iterdir():
        path = "/" if file.name == "index.html" else f"/{file.name}"
        status, content, headers = ask(server, path)

        assert (status, content) == (200, file.read_bytes())
        assert headers["Content-Type"].startswith(kinds[file.name.split(".")[1]])
        assert set(re.findall(r'from "(/[^"]+)"', content.decode())) <= STATIC.keys()
        assert b"https://" not in content
        assert b"http://" not in content.replace(b"http://www.w3.org/2000/svg", b"")
        assert "default-src 'none'" in headers["Content-Security-Policy"]


def test_maps_and_pictures_are_the_datasets_own(server, indexed_release):
    fields = ("left", "right", "disparity", "depth", "visible", "valid")
    sample = StereoPairs(indexed_release, scenes=SCENE, pairs=[(0, 3)], frames=2, fields=fields)[0]
    valid = sample["valid"][0].numpy()

    for name in ("disparity", "depth"):  # nan where nothing was measured
        _, content, _ = ask(server, f"/{name}.f32?{MOMENT}")
        wanted = np.where(valid, sample[name][0].numpy(), np.nan)
        np.testing.assert_array_equal(np.frombuffer(content, "<f4").reshape(64, 64), wanted)
    for name in ("left", "right"):
        _, content, headers = ask(server, f"/{name}.jpg?{MOMENT}")
        found = np.asarray(Image.open(io.BytesIO(content))).astype(int)
        assert headers["Content-Type"] == "image/jpeg"
        assert np.abs(found - sample[name].numpy().transpose(1, 2, 0)).mean() < 3
    _, content, _ = ask(server, f"/visible.u8?{MOMENT}")
    assert content == sample["visible"].numpy().astype(np.uint8).tobytes()


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "//etc/passwd", "/page.css/..",
        "/static/index.html", "/page.css%00", "/index.parquet",
    ],
)  # fmt: skip
def test_no_path_leads_out_of_the_page(server, path):
    status, content, _ = ask(server, path)

    assert status == 404
    assert json.loads(content) == {"error": "there is nothing here"}


def test_malformed_targets_and_all_but_reading_are_refused(server):
    assert ask(server, "http://[::1/")[0] == 400
    assert [ask(server, "/api/about", method=each)[0] for each in ("POST", "OPTIONS")] == [501] * 2


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"frame": "7"}, "has no frame 7: its 7 are 0 to 6"),
        ({"frame": "-1"}, "frame must be a whole number, got '-1'"),
        ({"left": "3", "right": "0"}, "there is no pair (3, 0)"),
        ({"right": "9"}, "there is no pair (0, 9)"),
        ({"frame": "9" * 5000}, "frame must be a whole number"),
    ],
)
def test_a_moment_that_is_not_there_is_refused_with_a_reason(server, change, reason):
    query = {"key": SCENE, "left": "0", "right": "3", "frame": "2"} | change

    status, content, _ = ask(server, f"/disparity.f32?{urlencode(query)}")
    assert status == 400
    assert reason in json.loads(content)["error"]


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", None])
def test_a_name_that_was_made_to_point_here_is_refused(server, host):
    port = server.server_address[1]

    told = None if host is None else host.format(port=port)
    status, content, _ = ask(server, "/api/about", headers={"Host": told})
    assert status == 403
    assert b"another host" in content
    assert ask(server, "/", headers={"Host": f"localhost:{port}"})[0] == 200


def test_no_answer_lets_another_origin_read_it(server):
    origin = {"Origin": "https://evil.example"}
    for path in ("/", "/api/about", f"/disparity.f32?{MOMENT}", "/nothing"):
        _, _, headers = ask(server, path, headers=origin)

        assert not [name for name in headers if name.lower().startswith("access-control")]
        assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
        assert headers["X-Content-Type-Options"] == "nosniff"


def test_only_the_loopback_interface_listens(server):
    assert server.server_address[0] == "127.0.0.1"
    with socket.socket() as other:
        other.settimeout(5)
        assert other.connect_ex(("127.0.0.2", server.server_address[1])) != 0


def test_many_threads_get_each_their_own_frame(server, indexed_release):
    """Asked at once and in no order, every answer is that of its own question."""
    wanted = {}
    pairs = StereoPairs(indexed_release, scenes=SCENE, pairs=[(0, 3), (2, 4)], frames="all",
                        fields=("disparity", "valid", "pair", "frame_index"))  # fmt: skip
    for sample in pairs:
        left, right = sample["pair"].tolist()
        measured = sample["disparity"].where(sample["valid"], float("nan")).numpy()
        wanted[left, right, int(sample["frame_index"])] = measured.tobytes()
    asked = [place for place in wanted for _ in range(2)]
    np.random.default_rng(0).shuffle(asked)

    def get(place):
        left, right, frame = (int(number) for number in place)
        moment = urlencode({"key": SCENE, "left": left, "right": right, "frame": frame})
        return ask(server, f"/disparity.f32?{moment}")[1] == wanted[left, right, frame]

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(get, asked))
