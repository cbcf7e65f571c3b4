"""Functions of the host in compiled programs: what they are given and return, their errors, and XLA's cache."""

import gc
import os
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.physics.host_call import HostFunction
from forgetmimic_jax.tracking.setup import cache_of_programs


def floats(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def test_arrays_of_every_type_arrive_as_they_are_and_results_come_back():
    seen = []

    def function(*arrays):
        seen.extend((array.dtype, array.shape, array.tolist()) for array in arrays)
        return arrays[0].sum(axis=1), np.array(arrays[1]), arrays[2] - 1

    shapes = (floats(2), jax.ShapeDtypeStruct((2, 1), bool), jax.ShapeDtypeStruct((), jnp.int32))
    call = HostFunction(function, shapes, b"types")
    given = (
        jnp.arange(6.0).reshape(2, 3),
        jnp.array([[True], [False]]),
        jnp.int32(-3),
        jnp.zeros((0, 4)),
        jnp.uint32(7),
    )
    sums, mask, less = jax.jit(call)(*given)
    assert seen == [
        (np.float32, (2, 3), [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]),
        (np.bool_, (2, 1), [[True], [False]]),
        (np.int32, (), -3),
        (np.float32, (0, 4), []),
        (np.uint32, (), 7),
    ]
    assert (sums.tolist(), mask.tolist(), int(less)) == ([3.0, 12.0], [[True], [False]], -4)


def test_in_a_loop_each_step_is_a_call_and_under_vmap_each_member():
    calls = []

    def twice(x):
        calls.append(x.copy())
        return (2 * x,)

    call = HostFunction(twice, (floats(2),), b"twice")
    end, _ = jax.lax.scan(lambda x, _: (call(x)[0], None), jnp.ones(2), None, length=3)
    assert (end.tolist(), len(calls)) == ([8.0, 8.0], 3)
    both = jax.vmap(lambda x: call(x)[0])(jnp.array([[1.0, 2.0], [3.0, 4.0]]))
    assert both.tolist() == [[2.0, 4.0], [6.0, 8.0]]
    assert [call.tolist() for call in calls[3:]] == [[1.0, 2.0], [3.0, 4.0]]


def test_an_error_has_its_message_and_the_next_call_works():
    def halved(x):
        if x[0] < 0.0:
            raise ValueError("found -1; accepted: 0 or more")
        return (x / 2,)

    call = jax.jit(HostFunction(halved, (floats(1),), b"halved"))
    with pytest.raises(jax.errors.JaxRuntimeError, match="ValueError: found -1; accepted: 0 or more"):
        call(-jnp.ones(1))
    assert call(jnp.ones(1))[0].tolist() == [0.5]


def test_results_of_another_number_or_shape_are_an_error():
    for result in ((), (np.zeros(2, np.float32),) * 2, (np.zeros(3, np.float32),)):
        call = HostFunction(lambda x, result=result: result, (floats(2),), f"wrong {len(result)}".encode())
        with pytest.raises(jax.errors.JaxRuntimeError, match="ValueError"):
            call(jnp.zeros(2))


def test_of_two_functions_of_one_description_the_one_that_is_left_is_called():
    functions = [HostFunction(lambda x: (x + 1,), (floats(),), b"plus one") for _ in range(2)]
    compiled = jax.jit(lambda x: functions[1](x)[0]).lower(jnp.float32(1.0)).compile()
    functions.pop()
    gc.collect()
    assert float(compiled(jnp.float32(1.0))) == 2.0
    functions.pop()
    gc.collect()
    with pytest.raises((jax.errors.JaxRuntimeError, ValueError), match="calls a function that no longer exists"):
        compiled(jnp.float32(1.0))


def test_programs_that_are_a_month_old_leave_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = cache_of_programs()
    assert folder.parent == tmp_path / "forgetmimic-jax" / "jax"
    folder.mkdir(parents=True)
    for days in (29, 31):
        path = folder / f"jit_{days}-cache"
        path.write_bytes(b"")
        os.utime(path, times=(time.time() - days * 24 * 3600,) * 2)
    assert cache_of_programs() == folder
    assert [path.name for path in folder.iterdir()] == ["jit_29-cache"]


PROGRAM = """
import jax, jax.numpy as jnp
from forgetmimic_jax.physics.host_call import HostFunction

hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if name.endswith("cache_hits") else None)
call = HostFunction(lambda x: (x * {factor},), (jax.ShapeDtypeStruct((), jnp.float32),), b"times {factor}")
two = jnp.float32(2.0)
hits.clear()
print(float(jax.jit(lambda x: call(x + 1)[0])(two)), len(hits))
"""


def test_another_process_takes_the_program_from_the_cache_and_calls_its_own_function(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    printed = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM.format(factor=factor)], capture_output=True, text=True, check=True
        )
        for factor in (3, 3, 4)
    ]
    assert [of.stdout.split() for of in printed] == [["9.0", "0"], ["9.0", "1"], ["12.0", "0"]]
