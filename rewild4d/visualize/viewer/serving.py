"""Open the page's port."""

import contextlib
import io
import socket

import viser

from rewild4d.errors import UserError, reason


class _Server(viser.ViserServer):
    """A server that never shows its page outside this machine through viser's public relay."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def open_server(host: str, port: int) -> viser.ViserServer:
    """Open an empty page.

    Args:
        host: address of this machine on which it is served.
        port: of the address; 0 for any that is free.

    Raises:
        UserError: the port is in use, or there is no such address.
    """
    if not 0 <= port < 65536:
        raise UserError(f"--port {port}: expected a number from 0 to 65535.")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise UserError(f"--host {host} --port {port}: cannot be served there: {reason(error)}.") from error
    with contextlib.redirect_stdout(io.StringIO()):  # its own greeting
        server = _Server(host, port, verbose=False)
    if port and server.get_port() != port:  # somebody was faster
        close_server(server)
        raise UserError(f"--host {host} --port {port}: cannot be served there: Address already in use.")
    return server


def close_server(server: viser.ViserServer) -> None:
    """Close the page, in all tabs."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
