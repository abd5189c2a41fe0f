"""Patience with a network: what is tried again, after which wait, and when to give up."""

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

_JITTER: Final = random.SystemRandom()
"""Not the program's own random numbers: reading must not disturb them."""


def _chance() -> float:
    return _JITTER.random()


class Fault(Exception):
    """Something that may pass if it is tried again; ``wait_s`` is what the other side asked for."""

    def __init__(self, what: str, *, wait_s: float = 0.0) -> None:
        """Say what happened."""
        super().__init__(what)
        self.wait_s = wait_s


@dataclass(frozen=True, slots=True)
class Patience:
    """How often to try, and how long to wait between.

    Attributes:
        attempts: Tries in a row without a byte gained before giving up.
        first_wait_s: Seconds before the second try; doubled for each that follows, and shortened
            at random by up to a half, so that many workers do not come back at once.
        longest_wait_s: Seconds that no wait of our own exceeds.
        longest_asked_s: Seconds that the other side may ask for; beyond them we give up.
        timeout_s: Seconds of silence that count as a fault.
        sleep: What waits.
        chance: What gives a number of 0 to 1.
    """

    attempts: int = 6
    first_wait_s: float = 0.5
    longest_wait_s: float = 30.0
    longest_asked_s: float = 300.0
    timeout_s: float = 30.0
    sleep: Callable[[float], None] = time.sleep
    chance: Callable[[], float] = _chance

    def wait(self, fault: Fault, *, failures: int) -> bool:
        """Wait before the next try, after so many failures in a row; False is to give up."""
        if failures >= self.attempts or fault.wait_s > self.longest_asked_s:
            return False
        own_s = min(self.longest_wait_s, self.first_wait_s * 2.0 ** (failures - 1))
        self.sleep(max(fault.wait_s, own_s * (1 - self.chance() / 2)))
        return True
