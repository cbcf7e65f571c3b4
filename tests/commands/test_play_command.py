from pathlib import Path

import pytest

from forgetmimic_jax import play
from forgetmimic_jax.viewing import server


@pytest.fixture
def options(base_run):
    def options(**given) -> play.Options:
        return play.Options(**{"checkpoint": base_run.checkpoint(4)} | given)

    return options


def test_base_and_unlearned_policy_are_served_from_the_first_target_on(unlearned_run, monkeypatch, capsys):
    seen = []

    def wait(self) -> None:
        seen.append((self._stage.names, self._stage.library.names, self._targets, self._first))
        raise KeyboardInterrupt

    monkeypatch.setattr(server.Server, "wait", wait)
    play.main(play.Options(checkpoint=unlearned_run.checkpoint(2), port=18180))
    assert seen == [(("base", "unlearned"), ("sway", "turn", "nod"), ("turn",), 1)]
    assert "Open http://127.0.0.1:18180 in a browser; Ctrl-C ends it." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot": "gg1", "checkpoint": None}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"checkpoint": Path("nowhere")}, "nowhere: no such checkpoint folder"),
        ({"port": 80}, "--port: found 80; accepted: 1024 to 65535"),
        ({"seed": -1}, "--seed: found -1; accepted: 0 or more"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(play.main, options(**given)) == message
