"""Methods by name, and the settings of a run that unlearns with one."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil

from forgetmimic_jax import unlearning
from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.settings.config import Config, UnlearnConfig
from forgetmimic_jax.unlearning.method import Method


def methods() -> dict[str, Method]:
    """Every method by its module's name."""
    names = [module.name for module in pkgutil.iter_modules(unlearning.__path__)]
    modules = {name: importlib.import_module(f"{unlearning.__name__}.{name}") for name in names}
    return {name: module.METHOD for name, module in modules.items() if hasattr(module, "METHOD")}


def find_method(name: str) -> Method:
    """The method called `name`.

    Raises:
        InputError: there is none.
    """
    known = methods()
    if name not in known:
        raise InputError(f"unlearn.method: no method '{name}'; {nearest(name, known)}")
    return known[name]


def method_of(config: Config) -> Method:
    """How a run trains: by its method if it has clips to forget, else by plain PPO.

    Raises:
        InputError: an unknown method, or a setting that the method does not have.
    """
    return _checked(config.unlearn) if config.unlearn.targets else Method()


def unlearning_config(base: Config, unlearn: UnlearnConfig) -> Config:
    """The base's run as an unlearning run: the method on, its clips, the sampler uniform, the wrench off; no more.

    The method's settings that are left out have their defaults.
    A method that trains a fresh policy on its own keeps the base's sampler and wrench: it is trained as the base was.

    Raises:
        InputError: an unknown method, or a setting that the method does not have.
    """
    method = _checked(unlearn)
    unlearn = dataclasses.replace(
        unlearn, settings={**method.settings, **unlearn.settings}, instead=unlearn.instead or method.instead
    )
    sampling = dataclasses.replace(base.sampling, clips=method.clips, target_share=0.0)  # which a base may have had
    wrench = base.wrench
    if method.start != "fresh":
        sampling = dataclasses.replace(sampling, rule="uniform_clips", first_frame=0.0)
        wrench = dataclasses.replace(wrench, max_gain=0.0)
    return dataclasses.replace(base, unlearn=unlearn, sampling=sampling, wrench=wrench)


def _checked(unlearn: UnlearnConfig) -> Method:
    """The method, which has every setting that is given for it."""
    method = find_method(unlearn.method)
    for name in unlearn.settings:
        if name not in method.settings:
            raise InputError(
                f"unlearn.settings: {unlearn.method} has no setting '{name}'; {nearest(name, method.settings)}"
            )
    if unlearn.instead is not None and method.instead is None:
        raise InputError(
            f"unlearn.instead: found {unlearn.instead}; accepted: nothing, since {unlearn.method} teaches nothing "
            "in the place of the targets"
        )
    if unlearn.stop_every and not method.stop_every:
        raise InputError(
            f"unlearn.stop_every: found {unlearn.stop_every}; accepted: 0, since {unlearn.method} has no stop rule"
        )
    return method
