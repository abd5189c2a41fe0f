"""Bytes from a server that fails: had all the same, each once, or an error that says why not."""

import re
import time

import pytest

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy
from tests.servers.failing_server import Answer, serving
from tests.sources.policies import retry_policy, waits_noted
from tests.sources.source_kit import read_range, size_of

DATA = bytes(range(256)) * 1000


@pytest.fixture
def waits(monkeypatch):
    return waits_noted(monkeypatch)


@pytest.fixture
def served(web):
    (web.folder / "x.tar").write_bytes(DATA)
    return web


def ranges(server):
    return [(asked.start, asked.stop) for asked in server.asked]


def test_the_size_costs_one_byte(served):
    assert size_of(f"{served.url}/x.tar") == len(DATA)
    assert served.sent == 1


def test_an_answer_cut_short_is_gone_on_with_where_it_ended(served, waits):
    served.answers = [Answer(stop_after=30_000), Answer(stop_after=100_000)]
    remote = RemoteObject(f"{served.url}/x.tar")

    assert remote.read(500, 200_500) == DATA[500:200_500]
    assert ranges(served) == [(500, 200_500), (30_500, 200_500), (130_500, 200_500)]
    assert served.sent == 200_000
    assert len(waits) == 2
    assert all(0.01 <= wait_s <= 0.02 for wait_s in waits)


def test_waits_double_up_to_a_limit_while_nothing_is_gained(served, waits):
    served.always["x.tar"] = Answer(status=503)
    remote = RemoteObject(f"{served.url}/x.tar", retry=retry_policy(longest_wait_s=3.0))

    with pytest.raises(StorageError, match=r"x.tar : .* byte 0 of 9 \(.* 503 .*; 10 tries\)"):
        remote.read(0, 9)
    longest_s = [0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28, 2.56, 3.0]
    for wait_s, most_s in zip(waits, longest_s, strict=True):
        assert most_s / 2 <= wait_s <= most_s


def test_silence_is_retried(served, waits):
    served.answers = [Answer(delay_s=1.0)]
    retry = retry_policy(attempts=999, timeout_s=0.2, longest_outage_s=60.0)

    assert RemoteObject(f"{served.url}/x.tar", retry=retry).read(0, 9) == DATA[:9]
    assert waits


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (Answer(404), r"404 .*\. Check the URL, and that the index and its shards lie in one"),
        (Answer(403), r"403 .*\. It may not be read with what the URL says: check access"),
        (Answer(401), r"401 .*\. It asks for a login"),
        (Answer(400), r"400 .*\. Check the URL and the server"),
        (Answer(whole=True), r"whole file \(256000 bytes\) .* 5 to 8.* use a server that honours"),
        (Answer(content_range="bytes 6-8/256000"), "sends bytes 6 to 8 .* asked for bytes 5 to 8"),
        (Answer(content_range="pages 5-8/256000"), r"206 .*which part .*\('?.*'pages 5-8/256000'"),
        (Answer(content_range=f"bytes 5-8/{'9' * 5000}"), "206 and does not state which part"),
        (Answer(content_range="bytes 5-8/*"), "206 and does not state .* the size of the whole"),
        (Answer(302, {"Location": "/x.tar"}), "is redirected more than 5 times"),
        (Answer(302), "the server answers 302"),
        (Answer(302, {"Location": "file:///etc/passwd"}), "correct it, or the redirect"),
    ],
)
def test_an_answer_that_will_not_pass_is_named_at_once(served, waits, answer, message):
    served.always["x.tar"] = answer
    remote = RemoteObject(f"{served.url}/x.tar")

    with pytest.raises(StorageError, match=rf"x.tar : .*{message}") as caught:
        remote.read(5, 9)
    assert len(str(caught.value)) < 400
    assert waits == []


def test_the_whole_may_be_sent_where_the_whole_is_requested(served):
    served.always["x.tar"] = Answer(whole=True)

    assert size_of(f"{served.url}/x.tar") == len(DATA)
    assert read_range(f"{served.url}/x.tar", 0, len(DATA)) == DATA


def test_a_file_that_ends_before_the_range_is_reported(served):
    with pytest.raises(StorageError, match=r"x.tar : .* 256000 bytes.* 256009 .*use the index"):
        read_range(f"{served.url}/x.tar", 256_000, 256_010)


@pytest.mark.parametrize(("start", "stop"), [(0, 9), (256_000, 256_010)])
def test_a_file_of_another_size_than_the_index_says_is_reported(served, start, stop):
    remote = RemoteObject(f"{served.url}/x.tar", expected_size=256_010)

    for _ in range(2):
        with pytest.raises(ShardError, match=r"x.tar : has 256000 bytes, .* says 256010"):
            remote.read(start, stop)


def test_a_login_in_the_url_is_sent_and_never_shown(served):
    url = served.url.replace("http://", "http://me:pass%20word@")
    read_range(f"{url}/x.tar?key=secret", 0, 9)

    assert served.asked[0].headers["authorization"] == "Basic bWU6cGFzcyB3b3Jk"
    served.always["x.tar"] = Answer(status=404)
    with pytest.raises(StorageError, match=re.escape(f"{served.url}/x.tar : ") + ".* 404"):
        read_range(f"{url}/x.tar?key=secret", 0, 9)


def test_a_query_is_neither_shown_nor_chained(waits):
    remote = RemoteObject("http://127.0.0.1:1/x.tar?key=secret", retry=retry_policy(attempts=1))
    with pytest.raises(StorageError, match=r"http://127\.0\.0\.1:1/x\.tar : .*try again") as caught:
        remote.read(0, 9)

    error: BaseException | None = caught.value
    while error is not None:
        assert "secret" not in str(error)
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


MONDAY, TUESDAY = "Mon, 02 Feb 2026 07:28:00 GMT", "Tue, 03 Feb 2026 07:28:00 GMT"


@pytest.mark.parametrize(
    ("before", "after", "message", "honours_if_range"),
    [
        ({"ETag": '"a"'}, {"ETag": '"b"'}, r'its ETag was "a" and is "b"', True),
        ({"ETag": 'W/"a"'}, {"ETag": 'W/"b"'}, r'its ETag was W/"a" and is W/"b"', False),
        ({"ETag": '"a"', "Last-Modified": MONDAY}, {"Last-Modified": TUESDAY},
         f"its Last-Modified was {MONDAY} and is {TUESDAY}", True),
    ],
)  # fmt: skip
def test_a_file_replaced_between_ranges_is_reported(
    served, before, after, message, honours_if_range
):
    served.validators, served.honours_if_range = before, honours_if_range
    remote = RemoteObject(f"{served.url}/x.tar")
    remote.read(0, 9)
    (served.folder / "x.tar").write_bytes(DATA[::-1])
    served.validators = after

    for _ in range(2):
        with pytest.raises(ShardError, match=rf"x.tar : was replaced on its server .*{message}\. "):
            remote.read(9, 18)


def test_a_file_of_another_size_is_reported_as_replaced_without_any_validator(served):
    remote = RemoteObject(f"{served.url}/x.tar")
    remote.read(0, 9)
    (served.folder / "x.tar").write_bytes(DATA[:-1])

    with pytest.raises(ShardError, match="its size was 256000 and is 255999"):
        remote.read(9, 18)


@pytest.mark.parametrize(
    ("validators", "condition"),
    [
        ({"ETag": '"a"', "Last-Modified": MONDAY}, '"a"'),
        ({"ETag": 'W/"a"', "Last-Modified": MONDAY}, None),
        ({"ETag": "odd \u00b2"}, None),
    ],
)
def test_later_ranges_are_requested_on_condition(served, validators, condition):
    served.validators = validators
    remote = RemoteObject(f"{served.url}/x.tar")

    assert remote.read(0, 9) + remote.read(9, 18) == DATA[:18]
    asked = [asked.headers.get("if-range") for asked in served.asked]
    assert asked == [None, condition]


def test_the_time_that_a_reader_takes_does_not_count(served):
    retry = retry_policy(attempts=3, timeout_s=0.2)
    chunks = RemoteObject(f"{served.url}/x.tar", retry=retry).chunks(0, len(DATA))
    data = next(chunks)
    time.sleep(0.5)

    assert data + b"".join(chunks) == DATA


@pytest.mark.parametrize("timeout_s", [0.0, float("nan")])
def test_a_retry_policy_without_an_end_is_refused(timeout_s):
    match = rf"RetryPolicy: timeout_s must be above 0, got {timeout_s}"
    with pytest.raises(StorageError, match=match):
        RetryPolicy(timeout_s=timeout_s)


@pytest.mark.parametrize("told", ["9" * 5000, "Fri, 21 Oct 99999 07:28:00 GMT"])
def test_a_retry_after_that_is_none_is_no_error_of_its_own(served, waits, told):
    served.always["x.tar"] = Answer(503, {"Retry-After": told})

    with pytest.raises(StorageError, match=r"the server answers 503 "):
        RemoteObject(f"{served.url}/x.tar", retry=retry_policy(attempts=2)).read(0, 9)


def test_a_login_is_not_sent_on_to_another_server(served, tmp_path):
    with serving(served.folder) as other:
        served.always["x.tar"] = Answer(status=302, headers={"Location": f"{other.url}/x.tar"})
        url = served.url.replace("http://", "http://me:word@")

        assert read_range(f"{url}/x.tar", 5, 9) == DATA[5:9]
        assert "authorization" in served.asked[0].headers
        assert "authorization" not in other.asked[0].headers
