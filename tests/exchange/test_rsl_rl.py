import os
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from damaged import ARCHIVES

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange import rsl_rl
from forgetmimic_jax.exchange.rsl_rl import read_rsl_rl, read_tensors

POLICIES = Path(__file__).parent / "rsl_rl"  # written by rsl_rl itself: make_rsl_rl_policies.py


@pytest.mark.parametrize("name", ["rsl_rl_2.3.3", "rsl_rl_3.3.0", "rsl_rl_5.5.1", "rsl_rl_5.5.1_raw"])
def test_the_actions_are_rsl_rls_own(name):
    actor, original = read_rsl_rl(POLICIES / f"{name}.pt", "elu"), np.load(POLICIES / f"{name}.npz")
    np.testing.assert_allclose(actor(original["observations"]), original["actions"], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(actor.std, original["std"], rtol=1e-6)  # 3.3.0's file has its logarithm
    assert (actor.hidden_layers, actor.iteration) == ((8, 6), 1500)
    assert (actor.mean is None) == name.endswith("raw")
    assert actor.count == (1e8 if name.endswith("raw") else 500)


def test_the_actions_of_a_network_of_the_papers_size_are_rsl_rls_own(tmp_path):
    pytest.importorskip("torch", reason="torch is no dependency; the small policies beside this file are always tested")
    pytest.importorskip("rsl_rl", reason="rsl-rl-lib is no dependency")
    from make_rsl_rl_policies import save_policy

    path = save_policy(tmp_path, hidden=[1024, 512, 256, 128])
    original = np.load(path.with_suffix(".npz"))
    found, expected = read_rsl_rl(path, "elu")(original["observations"]), original["actions"]
    assert np.abs(found - expected).max() <= 1e-5 * max(1.0, np.abs(expected).max())


@pytest.fixture
def copy(tmp_path) -> Path:
    return Path(shutil.copy(POLICIES / "rsl_rl_5.5.1.pt", tmp_path / "model_1500.pt"))


def settings(policy: Path, text: str) -> Path:
    path = policy.parent / "params" / "agent.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


@pytest.mark.parametrize("section", ["actor", "policy"])
def test_the_activation_is_taken_from_the_settings_beside_it(copy, section):
    path = settings(copy, f"seed: 1\n{section}:\n  hidden_dims: !!python/tuple [8, 6]\n  activation: elu\n")
    assert read_rsl_rl(copy, None).hidden_layers == (8, 6)
    path.write_text(f"{section}: {{activation: relu}}")
    with pytest.raises(InputError, match=r"activation: found 'relu'; accepted: elu$"):
        read_rsl_rl(copy, None)
    with pytest.raises(InputError, match=rf"--activation: found elu, but {path} says relu; leave the flag out$"):
        read_rsl_rl(copy, "elu")
    path.write_bytes(b"# \xe9\n")  # Latin 1
    with pytest.raises(InputError, match=rf"^{path}: not YAML: 'utf-8' codec"):
        read_rsl_rl(copy, None)


def test_settings_run_nothing(copy):
    settings(copy, "actor:\n  class: !!python/object/apply:os.abort []\n  activation: elu\n")
    assert read_rsl_rl(copy, None).iteration == 1500


@pytest.mark.parametrize(
    ("activation", "message"),
    [
        (None, r"activation: a checkpoint does not say it, .* give --activation elu if the hidden layers' is$"),
        ("tanh", r"activation: found 'tanh'; accepted: elu$"),
    ],
)
def test_an_activation_that_is_unknown_or_another_is_refused(copy, activation, message):
    with pytest.raises(InputError, match=message):
        read_rsl_rl(copy, activation)


def saved(path: Path, content: object, members: dict[str, bytes] | None = None) -> Path:
    """A file of torch.save's form whose pickle is `content`'s."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model/data.pkl", content if isinstance(content, bytes) else pickle.dumps(content, 2))
        for name, value in (members or {}).items():
            archive.writestr(f"model/data/{name}", value)
    return path


class Shell:
    def __reduce__(self):
        return os.system, ("touch stolen",)


def test_a_pickle_that_would_run_code_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = saved(tmp_path / "model.pt", {"infos": Shell()})
    with pytest.raises(InputError, match=rf"^{path}: refused: the pickle would call (posix|nt)\.system; accepted: "):
        read_tensors(path)
    assert not (tmp_path / "stolen").exists()


def tensor_file(path: Path, shown: tuple, storage: bytes) -> Path:
    """A file with one tensor of 6 numbers, spelt in pickle's opcodes with torch's names, without torch.

    `shown`: offset, size and stride.
    """

    def spelt(value) -> str:
        return f"({''.join(map(spelt, value))}t" if isinstance(value, tuple) else f"I{value}\n"

    kind = "(Vstorage\nctorch\nFloatStorage\nV0\nVcpu\nI6\ntQ"
    tensor = f"ctorch._utils\n_rebuild_tensor_v2\n({kind}{''.join(map(spelt, shown))}I00\nNtR"
    return saved(path, f"(dVx\n{tensor}s.".encode(), {"0": storage})


STORAGE = np.arange(6, dtype=np.float32).tobytes()


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        ((0, (2, 3), (3, 1)), [[0, 1, 2], [3, 4, 5]]),
        ((0, (3, 2), (1, 3)), [[0, 3], [1, 4], [2, 5]]),  # a transposed view
        ((2, (2,), (2,)), [2, 4]),
    ],
)
def test_tensors_are_what_their_strides_show(tmp_path, shown, expected):
    np.testing.assert_array_equal(read_tensors(tensor_file(tmp_path / "m.pt", shown, STORAGE))["x"], expected)


@pytest.mark.parametrize("shown", [(0, (7,), (1,)), (5, (2,), (1,)), (-1, (2,), (1,)), (0, (10**12,), (0,))])
def test_a_tensor_beyond_its_storage_is_refused(tmp_path, shown):
    with pytest.raises(InputError, match=r"not a readable file of .*ValueError: a tensor of \[.* in a storage of 6\)$"):
        read_tensors(tensor_file(tmp_path / "m.pt", shown, STORAGE))


LAYERS = {f"actor.{n}.{what}": np.zeros(shape) for n, sizes in ((0, (8, 132)), (2, (29, 8)))
          for what, shape in (("weight", sizes), ("bias", sizes[:1]))}  # fmt: skip
NORM = {"_mean": np.zeros((1, 132)), "_std": np.ones((1, 132)), "count": 500}


@pytest.mark.parametrize(
    ("state", "others", "message"),
    [
        ({}, {"iter": None}, "iter: found 'None'; accepted: a whole number, 0 or more"),
        ({}, {"iter": "x"}, "iter: found 'x'; accepted: a whole number, 0 or more"),
        ({}, {"obs_norm_state_dict": NORM | {"count": -5}}, "count: found [-5]; accepted: one number, 0 or more"),
        (
            {},
            {"obs_norm_state_dict": NORM | {"count": None}},
            "obs_norm_state_dict: count: found None; accepted: a tensor",
        ),
        ({}, {"obs_norm_state_dict": [1]}, "obs_norm_state_dict: found a list; accepted: a dict of tensors"),
        ({}, {"model_state_dict": [1]}, "model_state_dict: found a list; accepted: a dict of tensors"),
        ({}, {"actor_state_dict": None}, "actor_state_dict: found a NoneType; accepted: a dict of tensors"),
        ({"std": np.full(29, -0.5)}, {}, "std: found -0.5; accepted: 0 or more"),
        ({"std": None}, {}, "model_state_dict: std: found None; accepted: a tensor"),
        ({"actor.0.weight": 3}, {}, "actor.0.weight: found shape [] as module 0; accepted: linear layers with an"),
    ],
)
def test_a_checkpoint_with_values_that_cannot_be_is_refused(tmp_path, monkeypatch, state, others, message):
    content = {"model_state_dict": {**LAYERS, "std": np.ones(29)}, "obs_norm_state_dict": NORM, "iter": 3}
    path = tmp_path / "model.pt"
    monkeypatch.setattr(rsl_rl, "read_tensors", lambda path: content)  # arrays without torch's pickle
    assert read_rsl_rl(path, "elu").count == 500
    content["model_state_dict"] |= state
    content |= others
    with pytest.raises(InputError) as error:
        read_rsl_rl(path, "elu")
    assert str(error.value).startswith(f"{path}: {message}")


def test_what_is_no_such_checkpoint_is_refused(tmp_path):
    def message(path: Path) -> str:
        with pytest.raises(InputError) as error:
            read_rsl_rl(path, "elu")
        return str(error.value).removeprefix(f"{path}: ")

    assert message(tmp_path / "nowhere.pt") == "no such file"
    old = tmp_path / "old.pt"
    old.write_bytes(b"\x80\x02\x8a\nl\xfc\x9cF")
    assert message(old).startswith("not a readable file of torch.save, torch 1.6 or later (BadZipFile: ")
    pointer = tmp_path / "pointer.pt"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n")
    assert message(pointer) == "this is a Git LFS pointer, not the file: run git lfs pull"
    assert message(saved(tmp_path / "list.pt", [1])) == "found a list; accepted: the dict that rsl_rl saves"
    assert message(saved(tmp_path / "other.pt", {"iter": 3})).startswith("found iter; accepted: actor_state_dict or ")
    assert message(saved(tmp_path / "half.pt", pickle.dumps({"iter": 3})[:-3])).startswith(
        "not a readable file of torch.save"
    )
    recurrent = {"model_state_dict": {"memory_a.rnn.weight_ih_l0": np.zeros((4, 4))}}
    assert message(saved(tmp_path / "r.pt", recurrent)).startswith("found memory_a.rnn.weight_ih_l0; accepted: an MLP")
    assert message(saved(tmp_path / "none.pt", {"actor_state_dict": {}})).startswith("no mlp.0.weight in it; ")
    normed = {"mlp.0.weight": np.zeros((8, 132)), "mlp.0.bias": np.zeros(8), "mlp.1.weight": np.zeros(8)}
    message_of_norm = message(saved(tmp_path / "norm.pt", {"actor_state_dict": normed}))
    assert message_of_norm.startswith("mlp.1.weight: found shape [8] as module 1; accepted: linear layers with an ")


@pytest.mark.parametrize("damage", ARCHIVES)
def test_a_damaged_archive_is_one_line(copy, damage):
    copy.write_bytes(damage(copy))
    with pytest.raises(InputError, match=rf"^{copy}: not a readable file of torch\.save.*\([^\n]*\)$"):
        read_tensors(copy)
