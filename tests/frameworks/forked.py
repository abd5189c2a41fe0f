"""Two ranks with the environment that torchrun gives them, as forks that share all imports."""

import multiprocessing
import os
import socket

RANKS = 2


def forked_ranks(act, *values):
    """Return the exit status of each rank, a process of its own that calls a function."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": RANKS,
        "LOCAL_WORLD_SIZE": RANKS, "GROUP_RANK": 0, "TORCHELASTIC_RUN_ID": "none",
    }  # fmt: skip
    ranks = [
        multiprocessing.get_context("fork").Process(
            target=_as_rank, args=(shared | {"RANK": rank, "LOCAL_RANK": rank}, act, *values)
        )
        for rank in range(RANKS)
    ]
    for rank in ranks:
        rank.start()
    for rank in ranks:
        rank.join()
    return [rank.exitcode for rank in ranks]


def _as_rank(environment, act, *values):
    os.environ.update({name: str(value) for name, value in environment.items()})
    act(*values)
