"""Upper bounds of sizes that users choose, with reasons; a larger value is an error.

Without them a mistyped number runs for years or exhausts the memory before anything is reported.
"""

MAX_SEED = 2**63 - 1
"""Largest random seed: PyTorch and HDF5 hold it in 64 bits with a sign."""
MAX_COUNT = 10**9
"""Largest number of steps, scenes, attempts and the like: more take years."""
MAX_WORKERS = 1024
"""Largest number of worker processes; each takes about 0.3 GB of memory."""
MAX_NODES = 200
"""Largest number of nodes of a generated scene graph.

Such a graph has about 65 objects. The default tray holds about 20, which graphs of 60 nodes have.
"""
MAX_NETWORK_WIDTH = 4096
"""Largest width of the embeddings of a network, at which its weights take about 1 GB."""
MAX_IMAGE_SIDE = 4096
"""Largest width and height of an image [pixels]; its rendering takes seconds."""
MAX_MOTION_DURATION = 3600.0
"""Longest motion of the arm that is simulated [s]: it takes many minutes."""
MAX_SAMPLES = 1_000_000
"""Largest number of samples of a recorded move, which last hours."""
MAX_SAMPLE_RATE = 1000.0
"""Largest number of samples or images per second [Hz]: more than the plant has steps."""
