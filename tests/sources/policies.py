"""Retry policies with other numbers than the built-in ones, for tests that cannot wait."""

import threading

from stereogenbench_data.sources.retry import RetryPolicy

LONGEST_S = 50.0
"""What hangs in these tests hangs for longer, so that what waits for it fails."""


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


def retry_policy(*, timeout_s=20.0, sleep=None, chance=None, clock=None, **numbers):
    """Return a policy of other numbers, or whose waits, chance or clock are functions."""
    changes = dict(numbers)
    if sleep is not None:
        changes["sleep"] = lambda _, wait_s, *, cancellation: sleep(wait_s)
    if chance is not None:
        changes["chance"] = lambda _: chance()
    if clock is not None:
        changes["clock"] = lambda _: clock()
    return type("Limits", (RetryPolicy,), changes)(timeout_s)
