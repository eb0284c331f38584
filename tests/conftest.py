"""Fixtures that every test shares."""

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest
import warp as wp

from tests.builders.guided_runs import write_guided_inputs
from tests.builders.insertions import write_inputs
from tests.cases import CaseReport
from tests.slow import SlowTests
from warpir.render.device import start_warp

# A shell's background job ignores Ctrl-C, and so would every program that the tests start.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# With the kernels that runs in processes of their own keep, and find.
start_warp()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--cases``, from which docs/robustness.md is made, and ``--slow-until``."""
    parser.addoption("--cases", type=Path, help="write the outcomes of the numbered cases here")
    about = "when the last slow test without a number may start [s since 1970]"
    parser.addoption("--slow-until", type=float, help=about)


def pytest_configure(config: pytest.Config) -> None:
    """Note the outcomes of the numbered cases, and keep to a time, where that is asked for."""
    until = config.getoption("--slow-until")
    if until is not None:
        config.pluginmanager.register(SlowTests(until))
    path = config.getoption("--cases")
    if path is not None:
        config.pluginmanager.register(CaseReport(path, hasattr(config, "workerinput")))


def devices() -> list[str]:
    """Return the Warp devices to test on: the CPU, and CUDA where there is one.

    Without Warp's CPU compiler (``WARPIR_TEST_DEVICES=cuda``) the CPU is left out.
    """
    chosen = os.environ.get("WARPIR_TEST_DEVICES")
    if chosen:
        return chosen.split(",")
    return ["cpu", "cuda"] if wp.is_cuda_available() else ["cpu"]


@pytest.fixture(params=devices())
def device(request: pytest.FixtureRequest) -> str:
    """Name of the Warp device: the CPU, and a CUDA device where there is one."""
    return str(request.param)


@pytest.fixture
def rng() -> np.random.Generator:
    """Random numbers that are the same in every run and for every test."""
    return np.random.default_rng(12345)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photo, asset, camera and light of a small insertion, written once for a test module."""
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


@pytest.fixture(scope="module")
def guided_inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photo, asset, tiny model and weights of a small guided insertion."""
    folder = tmp_path_factory.mktemp("guided")
    write_guided_inputs(folder)
    return folder


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Let torch use one thread: networks this small lose more by threads than they gain."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the caches of a test in its own folder."""
    monkeypatch.setenv("WARPIR_CACHE", str(tmp_path / "cache"))


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Raise as soon as a test opens a socket or resolves a name."""

    def refuse(*args: object, **kwargs: object) -> NoReturn:
        raise RuntimeError("a test must not use the network")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    monkeypatch.setattr(socket.socket, "bind", refuse)
    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
