"""viser's server, on an address that was asked for, without a word of its own on the terminal."""

from __future__ import annotations

import io
import socket
from contextlib import redirect_stdout
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ..errors import ConfigError, MissingPackage

if TYPE_CHECKING:
    from viser import ViserServer

LOOPBACK = "127.0.0.1"
FIRST_PORT, PORTS = 8080, 100  # where a free one is looked for
HOW_TO_GET = "pip install 'mastd3r-slam[view]'"


def is_installed() -> bool:
    """Whether viser is here."""
    return find_spec("viser") is not None


def open_server(title: str, host: str = LOOPBACK, port: int | None = None) -> ViserServer:
    """Serve an empty scene, whose up is -y, on ``port``, or on a free one from 8080 on.

    Raises MissingPackage, and ConfigError for an address that cannot be served on.
    """
    if not is_installed():
        raise MissingPackage(f"the viewer: expected the package viser, got none; {HOW_TO_GET}")
    import viser

    chosen = free_port(host) if port is None else port
    if port is not None and (why := refused(host, port)):
        raise ConfigError(f"--host {host} --port {port}: expected an address to serve on, got {why}")
    with redirect_stdout(io.StringIO()):  # it prints a box with its own name
        server = viser.ViserServer(host=host, port=chosen, label=title, verbose=False)
    if port is not None and server.get_port() != port:  # somebody else was faster
        close_server(server)
        raise ConfigError(f"--host {host} --port {port}: expected an address to serve on, got one in use")
    server.request_share_url = _never_shared  # a page could ask for a tunnel to a public address
    server.scene.set_up_direction("-y")
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    return server


def close_server(server: ViserServer) -> None:
    """End it, quietly."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address(server: ViserServer) -> str:
    """Where a browser on this machine finds it."""
    host = {"0.0.0.0": LOOPBACK, "::": "::1"}.get(server.get_host(), server.get_host())
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def free_port(host: str) -> int:
    """The first port from 8080 on that can be served on. Raises ConfigError."""
    why: str | None = "none"
    try:
        socket.getaddrinfo(host, FIRST_PORT, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as e:  # a name server may take its time, and would be asked for every port
        reason = str(getattr(e, "strerror", None) or "a name that no host can have").lower()
        raise ConfigError(f"--host {host}: expected the name or address of this machine, got {reason}") from e
    for port in range(FIRST_PORT, FIRST_PORT + PORTS):
        why = refused(host, port)
        if why is None:
            return port
    raise ConfigError(f"--host {host}: expected a free port from {FIRST_PORT} on, got {why} on {PORTS} of them")


def refused(host: str, port: int) -> str | None:
    """Why the address cannot be served on; None where it can."""
    try:
        family, kind, _, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
            probe.listen(1)
    except UnicodeError:
        return "a name that no host can have"
    except (OSError, OverflowError) as e:
        return str(getattr(e, "strerror", None) or e).lower()
    return None


def _never_shared(*_: Any, **__: Any) -> None:
    return None
