"""Which network addresses may be connected to, and connecting to exactly the one that was checked.

A name is looked up once; every address it gives is checked; the connection goes to a checked address, not to the name.
So a name that changes its answer between the check and the connection (DNS rebinding) changes nothing, and a redirect
goes through the same check again because it needs a connection of its own.
"""

from __future__ import annotations

import ipaddress
import socket

from tasks.errors import MissingSourceError, RefusedSourceError, TransientError
from tasks.sources.policy import SourcePolicy

Address = ipaddress.IPv4Address | ipaddress.IPv6Address

_NAT64 = ipaddress.ip_network("64:ff9b::/96")
_V4_COMPATIBLE = ipaddress.ip_network("::/96")
_NO_SUCH_NAME = frozenset({socket.EAI_NONAME, getattr(socket, "EAI_NODATA", socket.EAI_NONAME)})


def refusal(address: Address) -> str | None:
    """Why an address is not a public one, None if it is; IPv4 addresses wrapped in IPv6 ones are looked at, too."""
    for inner in _unwrapped(address):
        if inner.is_loopback:
            return "this machine itself"
        if inner.is_multicast or inner.is_unspecified or inner.is_reserved:
            return "no single machine's address"
        if inner.is_link_local:
            return "a link-local address (cloud machines answer there with their credentials)"
        if not inner.is_global or (isinstance(inner, ipaddress.IPv6Address) and inner.is_site_local):
            return "an address inside a private network"
    return None


def address_of_literal(host: str) -> Address | None:
    """The address that a host literally is, also as `127.1`, `0x7f000001` or `2130706433`; None for a name."""
    try:
        return ipaddress.ip_address(host.strip("[]").partition("%")[0])
    except ValueError:
        pass
    try:
        return ipaddress.IPv4Address(socket.inet_aton(host))
    except (OSError, ValueError):
        return None


def resolve(host: str, port: int, policy: SourcePolicy) -> tuple[str, ...]:
    """Look a host up and return its addresses, all of them allowed.

    Raises:
        RefusedSourceError: one of them lies inside this network and the policy does not allow the host.
        MissingSourceError: there is no such host.
        TransientError: the look-up failed and may succeed later.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except socket.gaierror as error:
        if error.errno in _NO_SUCH_NAME:
            raise MissingSourceError(f"expected a host that exists, got {host!r}: check the address") from error
        raise TransientError(f"expected to look up {host!r}, got {error}: try again later") from error
    except UnicodeError as error:
        raise RefusedSourceError(f"expected a host name, got {host!r} ({error}): check the address") from error
    addresses = tuple(dict.fromkeys(str(entry[4][0]) for entry in found))
    if not policy.may_be_private(host):
        for address in addresses:
            why = refusal(ipaddress.ip_address(address.partition("%")[0]))
            if why:
                raise RefusedSourceError(
                    f"expected a public address, got {host!r}, which leads to {address}: {why}; "
                    "allow the host in AHOY_SOURCES__PRIVATE_HOSTS if that is meant"
                )
    return addresses


def connect(host: str, port: int, policy: SourcePolicy, timeout_s: float | None = None) -> socket.socket:
    """Open a TCP connection to one of the checked addresses of a host.

    Raises:
        RefusedSourceError, MissingSourceError, TransientError: see `resolve`; the latter also if nothing answers.
    """
    last: OSError | None = None
    for address in resolve(host, port, policy):
        try:
            return socket.create_connection((address, port), timeout_s or policy.connect_timeout_s)
        except OSError as error:
            last = error
    raise TransientError(f"expected {host}:{port} to answer, got {last}: try again later") from last


def _unwrapped(address: Address) -> tuple[Address, ...]:
    """The address and every IPv4 address that it carries inside."""
    if isinstance(address, ipaddress.IPv4Address):
        return (address,)
    if address.ipv4_mapped:
        return (address.ipv4_mapped,)
    inner: list[Address] = [address]
    if address.sixtofour:
        inner.append(address.sixtofour)
    if address.teredo:
        inner.extend(address.teredo)
    if address in _NAT64 or address in _V4_COMPATIBLE:
        inner.append(ipaddress.IPv4Address(int(address) & 0xFFFFFFFF))
    return tuple(inner)
