"""Weights and pictures by formula: what networks make of them can be computed by anyone."""

import math

import numpy as np
import torch


def known_state(network: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Return weights for every tensor of a network, by name and place alone."""
    return {
        name: _known(name, tensor) if tensor.is_floating_point() else tensor
        for name, tensor in network.state_dict().items()
    }


def known_pictures(*shape: int) -> np.ndarray:
    """Return uint8 pictures that are nowhere flat."""
    place = np.arange(math.prod(shape), dtype=np.float64).reshape(shape)
    return np.rint(127.5 + 127.5 * np.sin(0.37 * place + np.sin(0.011 * place))).astype(np.uint8)


def _known(name: str, tensor: torch.Tensor) -> torch.Tensor:
    wave = np.sin(0.7 * np.arange(tensor.numel(), dtype=np.float64) ** 1.1 + len(name))
    if tensor.ndim > 1:
        wave *= 2 / math.sqrt(tensor[0].numel())
    elif name.endswith(("running_var", "weight")):
        wave = 1 + wave / 2
    else:
        wave *= 0.1
    return torch.from_numpy(wave.astype(np.float32)).reshape(tensor.shape)
