"""What may be tried again: one table, the same for errors of our own, of the system and of optional packages."""

from __future__ import annotations

import errno
import socket

import httpcore
import httpx
import pytest
from pydantic import ValidationError

from ahoy_core.formats.errors import DamagedVideoError
from storage_schema.errors import CorruptError, StoreFullError
from tasks.errors import (
    BadInputError,
    ListError,
    MissingExtraError,
    MissingSourceError,
    RefusedSourceError,
    TransientError,
    UnusableSourceError,
    is_bad_input,
    is_transient,
)
from tasks.sources import SourcePolicy


def caused(error: BaseException, cause: BaseException) -> BaseException:
    try:
        raise error from cause
    except BaseException as raised:
        return raised


@pytest.mark.parametrize(
    "error",
    [
        TransientError("later"),
        TimeoutError(),
        ConnectionResetError(),
        BrokenPipeError(),
        OSError(errno.ENETUNREACH, "x"),
        OSError(errno.ESTALE, "x"),
        socket.gaierror(socket.EAI_AGAIN, "x"),
        httpx.ReadTimeout("x"),
        httpx.ConnectError("x"),
        httpcore.RemoteProtocolError("x"),
        caused(RuntimeError("a stage failed"), ConnectionResetError()),
    ],
    ids=repr,
)
def test_what_passes_is_tried_again(error: BaseException) -> None:
    assert is_transient(error) and not is_bad_input(error)


@pytest.mark.parametrize(
    "error",
    [
        BadInputError("x"),
        ListError("x"),
        RefusedSourceError("x"),
        MissingSourceError("x"),
        UnusableSourceError("x"),
        MissingExtraError("x"),
        DamagedVideoError("x"),
        caused(MissingSourceError("gone"), ConnectionResetError()),
    ],
    ids=repr,
)
def test_bad_input_never_is(error: BaseException) -> None:
    assert is_bad_input(error) and not is_transient(error)


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("a bug"),
        ValueError("x"),
        MemoryError(),
        CorruptError("x"),
        StoreFullError("/x", 1, None),
        OSError(errno.EACCES, "x"),
        socket.gaierror(socket.EAI_NONAME, "x"),
        httpx.InvalidURL("x"),
    ],
    ids=repr,
)
def test_faults_and_full_disks_are_neither(error: BaseException) -> None:
    assert not is_transient(error) and not is_bad_input(error)


def test_an_impossible_configuration_is_bad_input() -> None:
    with pytest.raises(ValidationError) as caught:
        SourcePolicy(attempts=0)
    assert is_bad_input(caught.value)


def test_errors_of_packages_that_need_not_be_there_are_known_by_name() -> None:
    exceptions = pytest.importorskip("botocore.exceptions")
    assert is_transient(exceptions.EndpointConnectionError(endpoint_url="http://127.0.0.1"))
    assert is_transient(exceptions.ReadTimeoutError(endpoint_url="http://127.0.0.1"))
    assert not is_transient(exceptions.NoCredentialsError())
    aiohttp = pytest.importorskip("aiohttp")
    assert is_transient(aiohttp.ServerDisconnectedError())


def test_a_cycle_of_causes_ends() -> None:
    first, second = RuntimeError("a"), RuntimeError("b")
    first.__cause__, second.__cause__ = second, first
    assert not is_transient(first)
