"""The page docs/results/arm.md."""

from collections.abc import Mapping
from typing import Any

from markdown_text import estimate, number, quantiles, section, significant, table
from results_files import (
    has_benchmark_results,
    has_training_results,
    read_benchmark_results,
    read_training_results,
)

RUNS = (
    ("arm_moves.json", "SNOPT, 5 ms"),
    ("arm_moves_2_5_ms.json", "SNOPT, 2.5 ms"),
    ("arm_moves_convex.json", "convex, 2.5 ms"),
    ("arm_moves_two_cups.json", "two cups"),
)
"""Results files of random moves: with one cup, trajectory optimizer and simulation time step."""
PEERS = "planner_peers.json"
"""Results file of `benchmarks/planner_peers.py`."""
GRASPS = {"JointHold": "weld (locked joint)", "HexapodHold": "compliant (hexapod)"}
"""Grasp constraints by their names in results files of version 0.1."""
SPEED = "simulation_speed.json"
"""Results file of the time of simulated moves."""
PLANNING = "planning_speed.json"
"""Results file of `benchmarks/planning_speed.py`."""
CUPS = "cup_sensitivity.json"
"""Results file of the effect of the numbers of suction cups."""
CLONING = "reaching_policies.json"
"""Results file of `training/train_bc.py`."""
OUTCOMES = {"carried out": "executed"}
"""Names of outcomes by those in results files of version 0.1."""
PARTS = {
    "inverse kinematics of a pose, eight branches": "inverse kinematics of a pose, all branches",
    "forward kinematics of a pose": "forward kinematics",
    "distances at joint angles": "signed distances at a configuration",
    "distances with gradients": "signed distances with gradients",
    "timing of a path without load": "time-optimal parameterization of a path",
    "sure plan": "plan without optimization",
    "optimised plan": "plan with optimization",
    "scene of distances": "collision model of a scene",
    "simulation, built": "simulation, built",
    "simulation, run": "simulation, run",
}
"""Names of the timed parts, by their names in the results file, from quick to slow."""


def _fraction(part: Mapping[str, Any]) -> str:
    low, high = part["interval"]
    successes = round(part["fraction"] * part["of"])
    return f"{part['fraction']:.3f} ({low:.3f} to {high:.3f}), {successes} of {part['of']}"


def _moves() -> str:
    runs = [(label, read_benchmark_results(name)) for name, label in RUNS]
    text = section(
        "Random pick-and-place moves",
        "Legal moves drawn uniformly in stable RG scenes of 25 nodes, ten per scene, UR10 with "
        "EPick. *Planned*: of the moves of which some grasp has collision-free endpoints. "
        "*Executed*: within 5 mm and 3 deg of the target, no other object moved by 5 mm; moves "
        "after "
        "which the pile collapses under teleportation too are not counted. Columns: trajectory "
        "optimizer and simulation time step, with one cup and rigid bellows; the last is the "
        "current configuration, with two cups, bending bellows, clear carries and steps of 5 ms "
        "that are repeated with 2.5 ms when anything unexpected happens.",
        command="python benchmarks/pick_place.py moves --count 1000 --nodes 25 --seed 29 "
        "--workers 2 --out FILE",
        seed="17, 29, 31, 29",
        results=[f"benchmarks/results/{name}" for name, _ in RUNS],
    )
    lines: list[tuple[str, Any]] = [
        ("moves", lambda run: str(sum(run["results"].values()))),
        ("planned", lambda run: _fraction(run["planned_of_possible"])),
        ("executed", lambda run: _fraction(run["carried_out_unless_unstable_anyway"])),
        (
            "executed, of all planned",
            lambda run: f"{run['results']['carried out']} of {run['carried_out_of_planned']['of']}",
        ),
        ("optimized transfer kept", lambda run: _fraction(run["optimised_carry_kept"])),
        ("optimized segments kept", lambda run: _fraction(run["optimised_phases_kept"])),
        ("duration / unoptimized, median", lambda run: number(run["motion_of_sure"]["p50"])),
        ("duration, median [s]", lambda run: number(run["motion_s"]["p50"], 1)),
        ("unoptimized duration, median [s]", lambda run: number(run["sure_motion_s"]["p50"], 1)),
        (
            "planning without optimization, median / 95th [s]",
            lambda run: quantiles(run["sure_planning_s"], 3),
        ),
        ("planning, median / 95th [s]", lambda run: quantiles(run["planning_s"], 2)),
        ("simulation, median / 95th [s]", lambda run: quantiles(run["simulation_wall_s"], 2)),
        (
            "placement error, median / 99th [mm]",
            lambda run: (
                f"{1000 * run['place_error_m']['p50']:.2f}"
                f" / {1000 * run['place_error_m']['p99']:.1f}"
            ),
        ),
        (
            "smallest distance to obstacles [mm]",
            lambda run: number(1000 * run["least_clearance_m"], 1),
        ),
    ]
    body = [[name, *(cell(run) for _, run in runs)] for name, cell in lines]
    text += table(["", *(label for label, _ in runs)], body)
    reasons = sorted({reason for _, run in runs for reason in run["results"]})
    text += "\n### Outcomes\n\nNumber of moves by outcome.\n\n"
    return text + table(
        ["outcome", *(label for label, _ in runs)],
        [
            [OUTCOMES.get(reason, reason), *(str(run["results"].get(reason, 0)) for _, run in runs)]
            for reason in reasons
        ],
    )


def _parts() -> str:
    seconds = read_benchmark_results("arm_parts.json")["seconds"]
    text = section(
        "Times of the parts",
        "One process, no other work; measured with the SNOPT optimizer and 5 ms steps.",
        command="python benchmarks/pick_place.py timing --count 20 --seed 3 --out FILE",
        seed=3,
        results=["benchmarks/results/arm_parts.json"],
    )
    return text + table(
        ["part", "median [ms]", "95th percentile [ms]"],
        [
            [name, *(significant(1000 * seconds[key][quantile]) for quantile in ("p50", "p95"))]
            for key, name in PARTS.items()
        ],
    )


def _grasps() -> str:
    rows = read_benchmark_results("arm_holds.json")["rows"]
    text = section(
        "Grasp constraints",
        "Optimized moves with the two constraints between cup and object; medians.",
        command="python benchmarks/pick_place.py grasp-constraints --count 20 --seed 0 --out FILE",
        seed=0,
        results=["benchmarks/results/arm_holds.json"],
    )
    head = ["scenes", "constraint", "executed", "other outcomes", "slip [mm]"]
    return text + table(
        [*head, "placement error [mm]", "wall time [s]"], [_grasp_row(r) for r in rows]
    )


LIMITS = {
    "position": "position",
    "velocity": "velocity",
    "acceleration": "acceleration",
    "jerk": "jerk",
    "torque": "torque",
    "load acceleration": "acceleration of the load",
    "cup load": "load of the cup, with safety factor",
}
"""Limits by their names in the results file."""


def _limits() -> str:
    results = read_benchmark_results("motion_limits.json")
    rows = results["rows"]
    text = section(
        "Limits of motions",
        "Random moves of the UR10, UR3e, UR5e, UR10e, UR16e and iiwa 14, each planned without and "
        "with optimization. Ratios to the limits are those of the returned trajectories at 500 Hz, "
        "with Drake's dynamics. *Time-optimal*: TOPP-RA along the same path without a limit of "
        "jerk, with steps of the acceleration also at rest. The results file holds the "
        "configuration of the planner.",
        command=f"python {results['command']} --out FILE",
        seed=results["seed"],
        results=[
            "benchmarks/results/motion_limits.json",
            "benchmarks/results/motion_limits.jsonl.gz",
        ],
    )
    body = [
        ["plans", *(str(row["count"]) for row in rows)],
        ["plans that exceed a limit by 1 %", *(str(row["exceeded"]) for row in rows)],
        *(
            [f"largest ratio: {name}", *(number(row["largest"][key], 3) for row in rows)]
            for key, name in LIMITS.items()
        ),
        ["duration, median [s]", *(number(row["duration_s"]) for row in rows)],
        ["duration / time-optimal, median", *(number(row["of_time_optimal"], 3) for row in rows)],
    ]
    return text + table(["", *(row["plans"] for row in rows)], body)


def _grasp_row(row: Mapping[str, Any]) -> list[str]:
    others = [f"{count} {reason}" for reason, count in row["results"].items()]
    others = [text for text in others if not text.endswith("carried out")]
    return [
        row["scenes"],
        GRASPS.get(row["hold"], row["hold"]),
        f"{row['results'].get('carried out', 0)} of {row['moves']}",
        ", ".join(others) or "none",
        number(1000 * row["slip_m"]["p50"], 3),
        number(1000 * row["place_error_m"]["p50"]),
        number(row["wall_s"]["p50"], 1),
    ]


def _grippers() -> str:
    results = read_benchmark_results("gripper_scenes.json")
    text = section(
        "Scenes within reach of a gripper",
        "Scenes in which no hidden object stays behind objects that the gripper cannot grasp, an "
        "upper bound on the scenes that the arm can solve. `one cup` is the default cell without "
        "its small cup.",
        command=f"python {results['command']} --out FILE",
        seed=f"dataset `{results['dataset']}`",
        results=["benchmarks/results/gripper_scenes.json"],
    )
    body = [[row["cell"], _fraction(row["solvable"])] for row in results["rows"]]
    text += table(["gripper", "solvable"], body) + "\n"
    moves = read_benchmark_results("gripper_moves.json")
    text += section(
        "Moves within reach of a gripper",
        f"Results of planning {moves['count']} random legal moves in stable RG scenes of 25 nodes, "
        "without simulation.",
        command=f"python {moves['command']} --out FILE",
        seed=moves["seed"],
        results=["benchmarks/results/gripper_moves.json"],
    )
    reasons = sorted({reason for row in moves["rows"] for reason in row["results"]})
    return text + table(
        ["result", *(row["cell"] for row in moves["rows"])],
        [
            [reason, *(str(row["results"].get(reason, 0)) for row in moves["rows"])]
            for reason in reasons
        ],
    )


def _peers() -> str:
    results = read_benchmark_results(PEERS)
    text = section(
        "Transfer motions of several planners",
        f"{results['count']} motions that carry an object between two poses above a pile of the "
        "random generator (25 nodes), with a vertical tool, on one core. Start, goal, limits and "
        "collision model are the same for all. Paths of OMPL are simplified and parameterized like "
        "ours; callbacks of the peers are Python. `KTO` is Drake's "
        "`KinematicTrajectoryOptimization`. Ours also keeps a distance for the sag of the load and "
        "for what may be hidden below the object. *All plan*: the "
        f"{results['planned_by_all']} motions that every planner finds.",
        command=f"python {results['command']} --out FILE",
        seed="3500 (`benchmarks/planning_problems.py`)",
        results=[f"benchmarks/results/{PEERS}"],
    )
    body = [
        [
            row["planner"],
            _fraction(row["planned"]),
            number(1000 * row["seconds"]["p50"], 1),
            number(1000 * row["seconds"]["p95"], 1),
            number(row["duration_s"]["p50"]),
            number(row["duration_s"]["p95"]),
            number(row["duration_if_all_plan_s"]["p50"]),
            number(1000 * row["least_clearance_m"], 1),
        ]
        for row in results["rows"]
    ]
    columns = [
        "planner",
        "planned",
        "planning, median [ms]",
        "planning, 95 % [ms]",
        "motion, median [s]",
        "motion, 95 % [s]",
        "motion if all plan, median [s]",
        "least clearance [mm]",
    ]
    return text + table(columns, body)


def _planning() -> str:
    results = read_benchmark_results(PLANNING)
    text = section(
        "Time of a plan",
        f"{results['count']} random moves in scenes of 25 nodes, planned in turn by an earlier "
        "version and by this one, on one core; processor time of the moves that were planned. "
        "*Lost*, *gained*: moves that only the earlier version plans, and only this one.",
        command=f"python {results['command']} --baseline DIR --out FILE",
        seed="that of `benchmarks/planning_problems.py`, in the name of the file",
        results=[f"benchmarks/results/{PLANNING}"],
    )
    rows = list[list[str]]()
    for kind, row in results["rows"].items():
        ratio = row["after / before"]
        rows += [
            [
                f"{kind}, median / 95th [ms]",
                *(quantiles(row[version]["seconds"], 1, 1000) for version in ("before", "after")),
                quantiles(ratio["seconds"], 2),
            ],
            [
                f"{kind}, mean duration of the motion",
                "",
                "",
                number(ratio["mean_duration"]),
            ],
            [
                f"{kind}, planned",
                *(_fraction(row[version]["planned"]) for version in ("before", "after")),
                f"lost {ratio['lost']}, gained {ratio['gained']}",
            ],
        ]
    return text + table(["", "before", "after", "after / before"], rows)


def _speed() -> str:
    results = read_benchmark_results(SPEED)
    rows = results["rows"]
    ratio = rows["before / after"]
    text = section(
        "Time of a simulated move",
        f"{results['count']} random moves in scenes of 25 nodes, simulated in turn by an earlier "
        "version whose bellows do not bend and by this one, whose bellows do, on one core; the "
        "results file names its commit. *Uneventful*: nothing fell, and no object is 5 mm from "
        "where it should be. Ratios are those of single moves; eventful ones are simulated twice. "
        "Differences of positions are the largest of all objects, over moves that "
        "are uneventful in both.",
        command=f"python {results['command']} --baseline DIR --out FILE",
        seed=results["seed"],
        results=[f"benchmarks/results/{SPEED}"],
    )
    versions = (rows["before"], rows["after"])
    return text + table(
        ["", "before", "after", "ratio before / after"],
        [
            [
                "processor time, median / 95th [s]",
                *(quantiles(row["cpu_s"], 2) for row in versions),
                quantiles(ratio["cpu"], 2),
            ],
            [
                "wall time, median / 95th [s]",
                *(quantiles(row["wall_s"], 2) for row in versions),
                quantiles(ratio["wall"], 2),
            ],
            ["processor time of all moves", "", "", number(ratio["total_cpu"])],
            ["uneventful", *(str(row["uneventful"]) for row in versions), ""],
            [
                "difference of final positions, median / 95th [mm]",
                "",
                "",
                quantiles(ratio["position_difference_m"], 2, 1000),
            ],
        ],
    )


def _cups() -> str:
    results = read_benchmark_results(CUPS)
    text = section(
        "Effect of the numbers of the suction cups",
        f"The same {results['count']} random moves, planned and simulated with one number of the "
        "gripper or of both cups changed by 30 %. *Load*: largest ratio of the load to the load "
        "capacity at the current vacuum. A vacuum of 1.3 times 80 % is impossible and shows the "
        "trend only.",
        command=f"python {results['command']} --out FILE",
        seed=results["seed"],
        results=[f"benchmarks/results/{CUPS}"],
    )
    head = ["number", "factor", "planned", "executed", "duration, median [s]"]
    return text + table(
        [*head, "placement error, median / 95th [mm]", "load, median / 95th"],
        [
            [
                row["number"],
                number(row["factor"], 1),
                str(row["planned"]),
                str(row["carried_out"]),
                number(row["duration_s"]["p50"]),
                quantiles(row["place_error_m"], 2, 1000),
                quantiles(row["load_ratio"], 2),
            ]
            for row in results["rows"]
        ],
    )


def _cloning() -> str:
    results = read_training_results(CLONING)
    training = results["rows"][0]["training"]
    text = section(
        "Policies cloned from recorded moves",
        "Networks that reach for a given object from home, cloned from the recorded approaches of "
        "a data set ([how to train them](../how_to/train_networks.md#reaching-policy)), control "
        f"the arm in the station at {1 / results['control_period_s']:g} Hz. *State*: sees the "
        "position of the object. *Depth*: sees the overhead depth image and the mask of the "
        f"object. They learn from moves of `{training['data']}` with the tool "
        f"`{training['tool']}`. Held-out moves are of `{results['data']}` from episode "
        f"{results['first_episode']} on, whose scenes are not among those of training or "
        "validation. *Reached*: the policy ends where the cup can attach to the object, "
        f"which has not moved by more than {results['max_displacement_mm']:g} mm.",
        command="python training/train_bc.py evaluate runs/bc_state runs/bc_depth "
        f"--data {results['data']} --first {results['first_episode']} --out FILE",
        seed=", ".join(str(seed) for seed in sorted({row["seed"] for row in results["rows"]})),
        results=[f"training/results/{CLONING}"],
    )
    header = ["policy sees", "moves learned from", "held-out moves", "reached", "duration [s]"]
    rows = [
        [
            row["observation"],
            str(row["moves"]),
            str(row["held_out"]),
            estimate(row, "reached", "reached_ci95"),
            number(row["duration_s"]),
        ]
        for row in results["rows"]
    ]
    return text + table(header, rows)


def page() -> str:
    """Return the page."""
    intro = (
        "# Arm\n\nPlanning and simulated execution of pick-and-place moves "
        "([motion planning](../explanation/motion_planning.md), "
        "[arm simulation](../explanation/arm_simulation.md)). Intervals are 95 %. Unless stated, "
        "placements are those of the rule *outermost* ([exploration](exploration.md)), bellows do "
        "not bend, and carries keep no clearance from hidden objects.\n\n"
    )
    sections = [_moves(), _limits(), _parts(), _grasps(), _grippers()]
    if has_benchmark_results(PEERS):
        sections.append(_peers())
    if has_benchmark_results(PLANNING):
        sections.append(_planning())
    if has_benchmark_results(SPEED):
        sections.append(_speed())
    if has_benchmark_results(CUPS):
        sections.append(_cups())
    if has_training_results(CLONING):
        sections.append(_cloning())
    return intro + "\n".join(sections)
