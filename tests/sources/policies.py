"""Retry policies and waits for tests that cannot wait."""

import threading

from stereogenbench_data.sources.retry import RetryPolicy

LONGEST_S = 50.0
"""What hangs in these tests hangs for longer, so that what waits for it fails."""


def waits_noted(monkeypatch):
    """Return the list of the waits between tries, in seconds, which take no time from now on."""
    seconds = []
    monkeypatch.setattr("stereogenbench_data.sources.retry.sleep", seconds.append)
    return seconds


def ended(call):
    """Return what a call returns, or raise what it raises; fail if it hangs."""
    found = []

    def run():
        try:
            found.append((call(), None))
        except BaseException as error:  # noqa: BLE001 - raised again
            found.append((None, error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(LONGEST_S)
    assert found, f"it still waits after {LONGEST_S} s"
    value, error = found[0]
    if error is not None:
        raise error
    return value


def retry_policy(*, timeout_s=20.0, **numbers):
    """Return a policy of other numbers than the built-in ones."""
    return type("Limits", (RetryPolicy,), numbers)(timeout_s)
