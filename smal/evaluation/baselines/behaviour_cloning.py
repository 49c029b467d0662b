"""Behaviour cloning: a small convolutional network that learns which key the expert holds, from one image.

Needs torch, which is no part of the package: ``pip install -e '.[cloning]'``.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from smal.action_space import Atom
from smal.evaluation.baselines.thumbnails import COLUMNS, ROWS

if TYPE_CHECKING:
    import torch as pytorch


class CloningUnavailableError(RuntimeError):
    """There is no torch on this machine."""


@dataclass(frozen=True)
class CloningSettings:
    """How to train.

    Parameters
    ----------
    epochs : int
        At most so many passes over the images, at least 1.
    patience : int
        Stops when the validation loss has not fallen for so many epochs; the best epoch counts.
    batch : int
        Images of one step.
    learning_rate, weight_decay : float
        Of AdamW.
    validation : float
        Share of the demonstrations that is kept for validation, above 0 and below 1; whole demonstrations, since the
        frames of one resemble each other. At least one is kept.
    seed : int
        Of the first weights, the split and the order of images.
    """

    epochs: int = 40
    patience: int = 6
    batch: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    validation: float = 0.15
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.patience, self.batch) < 1:
            raise ValueError("epochs, patience and batch must be at least 1")
        if not 0.0 < self.validation < 1.0:
            raise ValueError(f"validation must be above 0 and below 1, got {self.validation}")


def load_torch() -> ModuleType:
    """Import torch.

    Raises
    ------
    CloningUnavailableError
        It is not installed.
    """
    try:
        import torch  # noqa: PLC0415 - an extra, and seconds to import
    except ImportError:
        raise CloningUnavailableError(
            "behaviour cloning needs torch, which is not installed: pip install -e '.[cloning]'"
        ) from None
    module: ModuleType = torch
    return module


class ClonedBehaviour:
    """A trained network.

    Parameters
    ----------
    network : torch.nn.Module
        From images (n, 3, 48, 64), 0 to 1, to the scores (n, 5) of the atoms.
    """

    def __init__(self, network: "pytorch.nn.Module") -> None:
        self._torch = load_torch()
        self._network = network.eval()

    def scores(self, thumbnails: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the scores (n, 5) of the atoms for RGB thumbnails (n, 48, 64, 3)."""
        with self._torch.inference_mode():
            images = _tensor(self._torch, thumbnails)
            scores: NDArray[np.float32] = self._network(_scaled(images)).numpy()
        return scores

    def act(self, thumbnail: NDArray[np.uint8]) -> Atom:
        """Return what the expert would most likely do at a thumbnail (48, 64, 3)."""
        return Atom(int(self.scores(thumbnail[np.newaxis])[0].argmax()))


def clone(
    thumbnails: Sequence[NDArray[np.uint8]],
    atoms: Sequence[NDArray[np.int8]],
    settings: CloningSettings | None = None,
    progress: Callable[[int, float], None] = lambda _epoch, _loss: None,
) -> ClonedBehaviour:
    """Train a network on demonstrations.

    Some demonstrations tell how many epochs are enough; then a network is trained on all of them for so many.
    Cross-entropy, each atom weighted by one over the square root of its frequency: most frames go forward, and turns
    are what matters. The same settings and images give the same network on one machine.

    Parameters
    ----------
    thumbnails : sequence of uint8 arrays (f, 48, 64, 3)
        RGB images of every demonstration (`smal.evaluation.baselines.thumbnails`).
    atoms : sequence of int8 arrays (f,)
        What was done after each.
    settings : CloningSettings, optional
    progress : callable
        Called with the epoch, from 1, and its validation loss.

    Raises
    ------
    CloningUnavailableError
        There is no torch.
    ValueError
        Fewer than two demonstrations, or images and atoms that do not fit.
    """
    settings = settings or CloningSettings()
    _check(thumbnails, atoms)
    torch = load_torch()
    train, validation = _split(len(atoms), settings)

    def tensors(part: Sequence[int]) -> tuple["pytorch.Tensor", "pytorch.Tensor"]:
        images = _tensor(torch, np.concatenate([thumbnails[i] for i in part]))
        return images, _labels(torch, [atoms[i] for i in part])

    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        epochs = _choose_epochs(torch, tensors(train), tensors(validation), settings, progress)
        torch.manual_seed(settings.seed)
        network, everything = _network(torch), tensors(range(len(atoms)))
        for _ in islice(_epochs(torch, network, everything, _loss(torch, everything[1]), settings), epochs):
            pass
    return ClonedBehaviour(network)


def _check(thumbnails: Sequence[NDArray[np.uint8]], atoms: Sequence[NDArray[np.int8]]) -> None:
    if len(thumbnails) != len(atoms) or len(atoms) < 2:
        raise ValueError(
            f"cloning needs the images and atoms of at least two demonstrations, got {len(thumbnails)} and {len(atoms)}"
        )
    for number, (images, moves) in enumerate(zip(thumbnails, atoms, strict=True)):
        if images.shape != (len(moves), ROWS, COLUMNS, 3):
            raise ValueError(
                f"demonstration {number}: images (f, {ROWS}, {COLUMNS}, 3) and atoms (f,) do not fit: "
                f"{images.shape} and {moves.shape}"
            )


def _split(count: int, settings: CloningSettings) -> tuple[list[int], list[int]]:
    """Choose demonstrations for training and for validation."""
    order = np.random.default_rng(settings.seed).permutation(count).tolist()
    kept = min(count - 1, max(1, round(settings.validation * count)))
    return sorted(order[kept:]), sorted(order[:kept])


def _network(torch: ModuleType) -> "pytorch.nn.Sequential":
    """Four convolutions that halve the image each, and two full layers; 170,000 weights."""
    nn = torch.nn
    return nn.Sequential(
        nn.Conv2d(3, 24, 5, stride=2, padding=2), nn.BatchNorm2d(24), nn.ReLU(),
        nn.Conv2d(24, 48, 3, stride=2, padding=1), nn.BatchNorm2d(48), nn.ReLU(),
        nn.Conv2d(48, 64, 3, stride=2, padding=1), nn.BatchNorm2d(64), nn.ReLU(),
        nn.Conv2d(64, 64, 3, stride=2, padding=1), nn.BatchNorm2d(64), nn.ReLU(),
        nn.Flatten(), nn.Dropout(0.3), nn.Linear(64 * 3 * 4, 128), nn.ReLU(), nn.Linear(128, len(Atom)),
    )  # fmt: skip


def _loss(torch: ModuleType, labels: "pytorch.Tensor") -> "pytorch.nn.Module":
    frequency = torch.bincount(labels, minlength=len(Atom)).float()
    weights = frequency.clamp(min=1.0).rsqrt()
    loss: pytorch.nn.Module = torch.nn.CrossEntropyLoss(weight=weights / weights.sum())
    return loss


def _epochs(
    torch: ModuleType,
    network: "pytorch.nn.Module",
    part: tuple["pytorch.Tensor", "pytorch.Tensor"],
    loss_of: "pytorch.nn.Module",
    settings: CloningSettings,
) -> Iterator[int]:
    """Train, and yield the number of each epoch."""
    images, labels = part
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    for epoch in range(1, settings.epochs + 1):
        network.train()
        for batch in torch.randperm(len(labels)).split(settings.batch):
            if len(batch) < 2:
                continue  # one image has no variance to normalize by
            optimizer.zero_grad()
            loss_of(network(_scaled(images[batch])), labels[batch]).backward()
            optimizer.step()
        network.eval()
        yield epoch


def _choose_epochs(
    torch: ModuleType,
    seen: tuple["pytorch.Tensor", "pytorch.Tensor"],
    unseen: tuple["pytorch.Tensor", "pytorch.Tensor"],
    settings: CloningSettings,
    progress: Callable[[int, float], None],
) -> int:
    """Train until the validation loss falls no more, and return the best epoch."""
    network, loss_of = _network(torch), _loss(torch, seen[1])
    images, labels = unseen
    best, least = 1, float("inf")
    for epoch in _epochs(torch, network, seen, loss_of, settings):
        with torch.inference_mode():
            loss = float(loss_of(network(_scaled(images)), labels))
        progress(epoch, loss)
        if loss < least:
            best, least = epoch, loss
        elif epoch - best >= settings.patience:
            break
    return best


def _tensor(torch: ModuleType, thumbnails: NDArray[np.uint8]) -> "pytorch.Tensor":
    """Copy images (n, 48, 64, 3) into a tensor (n, 3, 48, 64), still of bytes: a quarter of the memory."""
    return torch.from_numpy(np.ascontiguousarray(thumbnails.transpose(0, 3, 1, 2)))


def _scaled(images: "pytorch.Tensor") -> "pytorch.Tensor":
    return images.float().div(255.0)


def _labels(torch: ModuleType, atoms: Sequence[NDArray[np.int8]]) -> "pytorch.Tensor":
    return torch.from_numpy(np.concatenate(atoms).astype(np.int64))
