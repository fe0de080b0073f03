"""Stands in for one flow run's process: asks the nursery for it, passes signals on, ends as it ends.

Run by path, with the standard library alone (`python -I -S relay.py SOCKET`): every run waits for this to start.
The worker sees an ordinary child process. If it is killed, its connection breaks and the nursery kills the run.
"""

import json
import os
import signal
import socket
import struct
import sys


def main() -> int:
    """Return the run's exit status, or die of the signal that it died of."""
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(sys.argv[1])
    order = json.dumps({"environment": dict(os.environ), "folder": os.getcwd()}).encode()  # noqa: PTH109 - no pathlib
    connection.sendall(struct.pack("!I", len(order)) + order)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, frame: connection.send(bytes([got])))
    answer = connection.recv(4)
    if len(answer) < 4:
        print("the nursery of this worker is gone, and its runs with it; restart the worker", file=sys.stderr)
        return 1
    status: int = struct.unpack("!i", answer)[0]
    if status < 0:
        if -status != signal.SIGKILL:
            signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    return status


if __name__ == "__main__":
    sys.exit(main())
