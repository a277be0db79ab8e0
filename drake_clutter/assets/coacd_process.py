"""Script that decomposes a mesh into convex pieces, as a process that can be stopped.

It reads the arrays `vertices` and `faces` as an NPZ file from standard input, takes the options of
CoACD as a JSON argument, and writes the corners of each piece as an NPZ file to standard output. It
imports nothing of the package, so that it starts quickly.
"""

import io
import json
import os
import sys

import numpy as np


def main() -> None:
    """Decompose the mesh on standard input."""
    # CoACD prints to standard output, which is kept for the result.
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    import coacd

    coacd.set_log_level("error")
    with np.load(io.BytesIO(sys.stdin.buffer.read())) as arrays:
        mesh = coacd.Mesh(arrays["vertices"], arrays["faces"])
    pieces = coacd.run_coacd(mesh, **json.loads(sys.argv[1]))
    arrays_out = {f"piece_{k:04d}": vertices for k, (vertices, _) in enumerate(pieces)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays_out)
    output.write(buffer.getvalue())
    output.close()


if __name__ == "__main__":
    main()
