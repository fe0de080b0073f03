"""Runs `ahoy server`'s supervisor, without installing the real flows: `python -m tests.batch.serve FOLDER PORT`."""

import sys
from pathlib import Path

from flows.serve.place import Place
from flows.serve.supervisor import Supervisor

if __name__ == "__main__":
    Supervisor(Place(Path(sys.argv[1])), port=int(sys.argv[2])).run(lambda server: print("ready", flush=True))
