"""Small policies of rsl_rl, saved as its runner saves them, beside actions that its own networks gave.

Needs torch and rsl-rl-lib, which are no dependencies here: `python tests/exchange/make_rsl_rl_policies.py FOLDER` wrote
tests/exchange/rsl_rl/ with versions 2.3.3, 3.3.0 and 5.5.1. Each version has a layout of its own.
"""

import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

OBSERVATIONS, ACTIONS, HIDDEN = 132, 29, [8, 6]


def save_policy(folder: Path, *, hidden: list[int] = HIDDEN, normalized: bool = True, log_std: bool = False) -> Path:
    """Write NAME.pt, and NAME.npz with observations [n, 132], the actions [n, 29] and the noise's std [29] there."""
    torch.manual_seed(0)
    installed = version("rsl-rl-lib")
    past = torch.randn(500, OBSERVATIONS) * torch.rand(OBSERVATIONS).exp() + torch.randn(OBSERVATIONS)
    past[:, 0] = 0.76  # a height that hardly changes: rsl_rl's epsilon matters there
    std = torch.linspace(0.1, 1.5, ACTIONS)
    make = {"2": _version_2, "3": _version_3}.get(installed[0], _version_5)
    content, act = make(past, std.log() if log_std else std, hidden, normalized, "log" if log_std else "scalar")
    path = folder / f"rsl_rl_{installed}{'' if normalized else '_raw'}.pt"
    folder.mkdir(parents=True, exist_ok=True)
    torch.save(content | {"iter": 1500, "infos": None}, path)
    with torch.inference_mode():
        seen = past[:20]
        np.savez(path.with_suffix(".npz"), observations=seen, actions=act(seen), std=std)
    return path


def _version_2(past, std, hidden, normalized, std_type):
    from rsl_rl.modules import ActorCritic, EmpiricalNormalization

    model = ActorCritic(
        OBSERVATIONS, 40, ACTIONS, actor_hidden_dims=hidden, critic_hidden_dims=[7], noise_std_type=std_type
    )
    optimizer = _trained(model, std)
    normalizer = EmpiricalNormalization([OBSERVATIONS], until=int(1e8)) if normalized else torch.nn.Identity()
    normalizer(past)  # this version learns as it is called
    normalizer.eval()
    content = {"model_state_dict": model.state_dict(), "optimizer_state_dict": optimizer}
    if normalized:
        privileged = EmpiricalNormalization([40], until=int(1e8))
        content |= {
            "obs_norm_state_dict": normalizer.state_dict(),
            "privileged_obs_norm_state_dict": privileged.state_dict(),
        }
    return content, lambda x: model.act_inference(normalizer(x))


def _version_3(past, std, hidden, normalized, std_type):
    from rsl_rl.modules import ActorCritic
    from tensordict import TensorDict

    def group(x):
        return TensorDict({"policy": x, "critic": x[:, :40]}, batch_size=len(x))

    model = ActorCritic(
        group(past),
        {"policy": ["policy"], "critic": ["critic"]},
        ACTIONS,
        actor_obs_normalization=normalized,
        critic_obs_normalization=normalized,
        actor_hidden_dims=hidden,
        critic_hidden_dims=[7],
        noise_std_type=std_type,
    )
    optimizer = _trained(model, std)
    model.update_normalization(group(past))
    model.eval()
    content = {"model_state_dict": model.state_dict(), "optimizer_state_dict": optimizer}
    return content, lambda x: model.act_inference(group(x))


def _version_5(past, std, hidden, normalized, std_type):
    from rsl_rl.models import MLPModel
    from tensordict import TensorDict

    def group(x):
        return TensorDict({"policy": x, "critic": x[:, :40]}, batch_size=len(x))

    groups = {"actor": ["policy"], "critic": ["critic"]}
    gaussian = {"class_name": "rsl_rl.modules.distribution:GaussianDistribution", "std_type": std_type}
    actor = MLPModel(group(past), groups, "actor", ACTIONS, hidden, "elu", normalized, gaussian)
    critic = MLPModel(group(past), groups, "critic", 1, [7], "elu", normalized)
    optimizer = _trained(actor, std)
    actor.update_normalization(group(past))
    actor.eval()
    content = {
        "actor_state_dict": actor.state_dict(),
        "critic_state_dict": critic.state_dict(),
        "optimizer_state_dict": optimizer,
    }
    save_policy.exported = actor.as_onnx(verbose=False)
    return content, lambda x: actor(group(x))


def _trained(model, std) -> dict:
    """The state of an optimiser that has taken a step, after which the weights are not tiny and the noise is `std`."""
    optimizer = torch.optim.Adam(model.parameters())
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    for name, parameter in model.named_parameters():
        parameter.data = std.clone() if "std" in name else parameter.data + 0.2 * torch.randn_like(parameter)
    return optimizer.state_dict()


def export_onnx(path: Path) -> None:
    """The policy last saved, by mjlab's call of torch's exporter."""
    module = save_policy.exported
    names = {"input_names": module.input_names, "output_names": module.output_names}
    torch.onnx.export(module, module.get_dummy_inputs(), path, opset_version=18, dynamo=False, **names)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    saved = save_policy(folder, log_std=version("rsl-rl-lib")[0] == "3")
    if version("rsl-rl-lib")[0] == "5":
        export_onnx(saved.with_suffix(".onnx"))
        save_policy(folder, normalized=False)
