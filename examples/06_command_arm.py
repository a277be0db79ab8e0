"""Move the arm along a joint trajectory of your own, in a Drake diagram of your own."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, Multiplexer, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter import ClutterStation, Pose, SceneObject, default_cell, load_catalog


def main() -> None:
    cell = default_cell()
    can = load_catalog().classes["master_chef_can"]
    objects = [SceneObject("can", can, Pose((0.0, 0.0, can.size[2] / 2)))]

    # From home, the first joint turns by 0.5 rad and back within two seconds.
    home = np.array(cell.robot.home)
    turned = home + np.eye(len(home))[0] * 0.5
    q_desired = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, 1.0, 2.0],
        np.column_stack([home, turned, home]),
        np.zeros_like(home),
        np.zeros_like(home),
    )

    # The command port takes positions, velocities and feed-forward torques, here none.
    builder = DiagramBuilder()
    station = builder.AddSystem(ClutterStation(cell, [("can", can)], time_step=0.0025))
    motion = builder.AddSystem(TrajectorySource(q_desired, output_derivative_order=1))
    torque = builder.AddSystem(ConstantVectorSource(np.zeros_like(home)))
    command = builder.AddSystem(Multiplexer([2 * len(home), len(home)]))
    builder.Connect(motion.get_output_port(), command.get_input_port(0))
    builder.Connect(torque.get_output_port(), command.get_input_port(1))
    builder.Connect(command.get_output_port(), station.GetInputPort("command"))
    simulator = Simulator(builder.Build())

    root = simulator.get_mutable_context()
    station.set_state(root, home, objects)
    for time in np.linspace(0.0, 2.0, 9):
        simulator.AdvanceTo(time)
        q = station.joint_positions(station.plant_context(root))
        error = np.abs(q - q_desired.value(time).ravel()).max()
        print(f"{time:.2f} s: joint 1 at {q[0]:.3f} rad, largest error {error:.4f} rad")


if __name__ == "__main__":
    main()
