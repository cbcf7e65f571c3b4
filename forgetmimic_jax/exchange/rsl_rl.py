"""rsl_rl's checkpoints (model_N.pt), read without torch and without running what a pickle may ask for.

Layouts of rsl_rl 1 to 3 (`model_state_dict`, with the normaliser beside or inside) and 4 to 5 (`actor_state_dict`), as
its runners save them; its empirical normalisation divides by standard deviation + 0.01.
"""

from __future__ import annotations

import collections
import io
import math
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import check_no_pointer, readable
from forgetmimic_jax.exchange.imported import UNKNOWN_COUNT, ImportedActor
from forgetmimic_jax.motion.unpickle import NumbersOnly, Refused

EPSILON = 0.01  # of EmpiricalNormalization
ACTIVATION = "elu"
SETTINGS = Path("params") / "agent.yaml"  # what Isaac Lab and mjlab write beside the checkpoints
STORAGES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}


def read_rsl_rl(path: Path, activation: str | None) -> ImportedActor:
    """The actor of a checkpoint.

    Args:
        path: model_N.pt.
        activation: of the hidden layers; None: what params/agent.yaml beside the file says.

    Raises:
        InputError: not such a checkpoint, a pickle that would run code, another network or activation.
    """
    check_no_pointer(path)
    content = read_tensors(path)
    _check_activation(path, activation)
    try:
        if "actor_state_dict" in content:
            return _version_4(content, path)
        if "model_state_dict" in content:
            return _version_1(content, path)
    except KeyError as error:
        raise InputError(f"{path}: no {error.args[0]} in it; a checkpoint of rsl_rl's MLP actor is needed") from None
    found = ", ".join(map(str, content)) or "nothing"
    raise InputError(f"{path}: found {found}; accepted: actor_state_dict or model_state_dict, as rsl_rl saves")


def _version_4(content: Mapping[str, Any], path: Path) -> ImportedActor:
    state = _state(content["actor_state_dict"], f"{path}: actor_state_dict")
    _check_only(state, r"mlp\.|obs_normalizer\.|distribution\.(std|log_std)_param$", path)
    return _actor(
        layers=_layers(state, "mlp", path),
        normalizer=_part(state, "obs_normalizer."),
        std=state.get("distribution.std_param"),
        log_std=state.get("distribution.log_std_param"),
        iteration=content.get("iter", 0),
        path=path,
    )


def _version_1(content: Mapping[str, Any], path: Path) -> ImportedActor:
    state = _state(content["model_state_dict"], f"{path}: model_state_dict")
    beside = content.get("obs_norm_state_dict")
    _check_only(state, r"(actor|critic)\.|(actor|critic)_obs_normalizer\.|(log_)?std$", path)
    return _actor(
        layers=_layers(state, "actor", path),
        normalizer=_part(state, "actor_obs_normalizer.")
        or ({} if beside is None else _state(beside, f"{path}: obs_norm_state_dict")),
        std=state.get("std"),
        log_std=state.get("log_std"),
        iteration=content.get("iter", 0),
        path=path,
    )


def _actor(
    *,
    layers: tuple[tuple[np.ndarray, np.ndarray], ...],
    normalizer: Mapping[str, np.ndarray],
    std: np.ndarray | None,
    log_std: np.ndarray | None,
    iteration: Any,
    path: Path,
) -> ImportedActor:
    std = std if log_std is None else np.exp(log_std)
    if std is not None and (std < 0.0).any():
        raise InputError(f"{path}: std: found {std.min():g}; accepted: 0 or more")
    if type(iteration) is not int or iteration < 0:
        raise InputError(f"{path}: iter: found {str(iteration)[:40]!r}; accepted: a whole number, 0 or more")
    if not normalizer:
        return ImportedActor(layers, std=std, iteration=iteration)
    return ImportedActor(
        layers,
        mean=normalizer["_mean"].reshape(-1),
        scale=normalizer["_std"].reshape(-1) + np.float32(EPSILON),
        count=_count(normalizer, path),
        std=std,
        iteration=iteration,
    )


def _count(normalizer: Mapping[str, np.ndarray], path: Path) -> float:
    """Observations behind a normaliser."""
    count = normalizer.get("count", np.array(UNKNOWN_COUNT))
    if count.size != 1 or not 0 <= count.item() < math.inf:
        raise InputError(f"{path}: count: found {str(count.reshape(-1))[:40]}; accepted: one number, 0 or more")
    return float(count.item())


def _state(state: Any, where: str) -> dict[str, np.ndarray]:
    """Tensors by name; a number is one too."""
    if not isinstance(state, Mapping):
        raise InputError(f"{where}: found a {type(state).__name__}; accepted: a dict of tensors")
    for name, value in state.items():
        if not isinstance(value, np.ndarray | np.generic | int | float):
            raise InputError(f"{where}: {name}: found {str(value)[:40]}; accepted: a tensor")
    return {str(name): np.asarray(value) for name, value in state.items()}


def _layers(state: Mapping[str, np.ndarray], prefix: str, path: Path) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The linear layers of a Sequential whose every second module is an activation."""
    numbers = sorted(int(name.split(".")[1]) for name in state if re.fullmatch(rf"{prefix}\.\d+\.weight", name))
    if not numbers:
        raise KeyError(f"{prefix}.0.weight")
    for place, number in enumerate(numbers):
        weight = state[f"{prefix}.{number}.weight"]
        if number != 2 * place or weight.ndim != 2:
            raise InputError(
                f"{path}: {prefix}.{number}.weight: found shape {list(weight.shape)} as module {number}; accepted: "
                f"linear layers with an activation between two"
            )
    return tuple((state[f"{prefix}.{number}.weight"].T, state[f"{prefix}.{number}.bias"]) for number in numbers)


def _part(state: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _check_only(state: Mapping[str, Any], accepted: str, path: Path) -> None:
    """InputError for parameters that are none of an MLP actor: a recurrent one, for example."""
    others = [name for name in state if not re.match(accepted, name)]
    if others:
        raise InputError(f"{path}: found {', '.join(others[:3])}; accepted: an MLP actor with a normaliser and a noise")


def _check_activation(path: Path, activation: str | None) -> None:
    """The file does not say its activation; its settings or the user must."""
    settings = path.parent / SETTINGS
    said = _said_activation(settings)
    if activation is not None and said is not None and activation != said:
        raise InputError(f"--activation: found {activation}, but {settings} says {said}; leave the flag out")
    found = activation or said
    if found is None:
        raise InputError(
            f"{path}: activation: a checkpoint does not say it, and there is no {settings} that does; "
            f"give --activation {ACTIVATION} if the hidden layers' is"
        )
    if found.lower() != ACTIVATION:
        raise InputError(f"{path}: activation: found '{found}'; accepted: {ACTIVATION}")


def _said_activation(settings: Path) -> str | None:
    try:
        content = yaml.load(settings.read_text(), Loader=_PlainLoader)
    except FileNotFoundError:
        return None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8
        raise InputError(f"{settings}: not YAML: {str(error).splitlines()[0]}") from None
    for section in ("actor", "policy"):  # rsl_rl 4 and later, and before
        part = content.get(section) if isinstance(content, dict) else None
        if isinstance(part, dict) and "activation" in part:
            return str(part["activation"])
    return None


class _PlainLoader(yaml.SafeLoader):
    """YAML whose Python objects, which these settings have, are read as nothing."""


_PlainLoader.add_multi_constructor("", lambda loader, tag, node: None)


def read_tensors(path: Path) -> dict[str, Any]:
    """A file of torch.save: containers, numbers and tensors, these as numpy arrays.

    Raises:
        InputError: not such a file, a damaged one, or a pickle that would call anything else.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    with readable(path, "file of torch.save, torch 1.6 or later"), zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(names) != 1:
            raise InputError(f"{path}: no data.pkl in it; accepted: a file of torch.save")
        try:
            content = _Tensors(archive, names[0].removesuffix("data.pkl")).load()
        except Refused as error:
            raise InputError(f"{path}: refused: the pickle would call {error}; accepted: tensors and numbers") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: found a {type(content).__name__}; accepted: the dict that rsl_rl saves")
    return content


class _Tensors(NumbersOnly):
    """An unpickler that builds tensors from the archive's storages as numpy arrays, and calls nothing else."""

    def __init__(self, archive: zipfile.ZipFile, prefix: str):
        super().__init__(io.BytesIO(archive.read(f"{prefix}data.pkl")))
        self._archive, self._prefix = archive, prefix

    def persistent_load(self, pid: Any) -> np.ndarray:
        kind, storage, key, _location, _count = pid
        if kind != "storage":
            raise ValueError(f"a {kind} in place of a storage")
        return np.frombuffer(self._archive.read(f"{self._prefix}data/{key}"), storage)

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch" and name in STORAGES:
            return np.dtype(STORAGES[name])
        known = {
            ("torch._utils", "_rebuild_tensor_v2"): _tensor,
            ("torch._utils", "_rebuild_parameter"): lambda tensor, *_: tensor,
            ("collections", "OrderedDict"): collections.OrderedDict,
        }
        return known[module, name] if (module, name) in known else super().find_class(module, name)


def _tensor(storage: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> np.ndarray:
    """A copy of the elements of a storage that a tensor shows."""
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    fits = last < len(storage) and math.prod(size) <= len(storage)
    if min((*size, *stride, offset)) < 0 or (0 not in size and not fits):
        raise ValueError(f"a tensor of {list(size)} in a storage of {len(storage)}")
    index = np.full(size, offset)
    for axis, (n, step) in enumerate(zip(size, stride, strict=True)):
        index += (np.arange(n) * step).reshape(-1, *[1] * (len(size) - axis - 1))
    return storage[index]
