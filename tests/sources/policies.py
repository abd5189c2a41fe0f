"""Retry policies with other numbers than the built-in ones, for tests that cannot wait."""

from stereogenbench_data.sources.retry import RetryPolicy


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
