"""A flag in Python: build a scene, step it, look at the numbers, change a parameter.

    python examples/flag.py
"""

import numpy as np

import loomtree

scene = {
    "name": "flag",
    "resolution": 2000,
    "simulation": {"step_s": 0.004, "steps_per_frame": 10, "frames": 25},
    "air": {"wind_m_s": [9.0, 0.5, 3.5], "density_kg_m3": 1.2},
    "cloth": [{"name": "flag", "sheet": {"size_m": [3.0, 2.0]}, "origin_m": [0.0, 1.0, 0.0], "fabric": "nylon"}],
    "pin": [{"edge": "left"}],
}

# One simulation on two workers; positions are NumPy arrays.
with loomtree.Simulation(scene, workers=2) as flag:
    corner = int(np.argmax(flag.positions[:, 0] + flag.positions[:, 1]))
    for _ in range(5):
        flag.advance(flag.steps_per_frame)
        x, y, z = flag.positions[corner]
        speed = np.linalg.norm(flag.velocities, axis=1).max()
        print(f"t = {flag.time_s:.2f} s: corner at {x:.2f}, {y:.2f}, {z:.2f} m, fastest vertex {speed:.1f} m/s")

# The same flag in three winds from the side: how far does it swing out?
for wind in (1.0, 3.0, 9.0):
    with loomtree.Simulation(scene, set={"air.wind_m_s": [9.0, 0.5, wind]}) as flag:
        flag.advance(50)
        print(f"{wind:.0f} m/s from the side: {np.ptp(flag.positions[:, 2]):.2f} m wide after {flag.time_s:.1f} s")
