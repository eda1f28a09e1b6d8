"""What each bench measures, in a sentence, and the layouts of its tables."""

from dataclasses import dataclass
from typing import Any

from bench.layout import OURS, Recorded, Table, Targets

CHOSEN: dict[str, Any] = {"at": "chosen"}
TIGHT: dict[str, Any] = {"at": 1e-6}
CVODES, KVAERNO5, SCANNED = "CVODES (CasADi)", "diffrax Kvaerno5", "legs in `lax.scan`"
VMAP, GROUPS, SWEEP, HAND = "vmap", "lax.map, 64 at a time", "sweep", "JAX by hand"
MANY = ("run of many", "error of many")


@dataclass(frozen=True)
class Report:
    """A bench in the pages: what it measures, its page and its tables."""

    says: str
    page: str
    tables: tuple[Table | Targets, ...]


def _lugre(setting: str) -> tuple[Table | Targets, ...]:
    one = Table(
        f"LuGre test bench at an error of at most 1e-6, medians, all in one process, {setting} `jaxmodsim.tune_cpu()`."
        " Run: a call of `simulate`, of a jitted function (diffrax), or of CasADi's integrator (CVODES). Differentiated"
        " run: a call of the jitted function of six parameters whose derivatives are measured.",
        ("rtol", "steps", "error of v", "run", "differentiated run", "jacobian", "gradient", "error of the gradient"),
        where=CHOSEN,
    )
    many = Table(
        "{runs} runs with different parameters ({runs_of_a_loop} in loops), error of the end velocity.",
        MANY, ("peer", "at"),
    )  # fmt: skip

    def targets(r: Recorded) -> list[tuple[str, str, float]]:
        own, loop = r.number("run", **CHOSEN), r.number("run of many", peer=CVODES, at="loop")
        jitted, cvodes = r.number("differentiated run", **CHOSEN), r.number("run", peer=CVODES, **CHOSEN)
        fastest = min(r.number("run", peer=name, **CHOSEN) for name in r.all_of("run", "peer") if "diffrax" in name)
        return [
            ("CVODES over a call of `simulate`", ">= 8", cvodes / own),
            ("CVODES over a jitted run", ">= 8", cvodes / jitted),
            ("fastest solver of diffrax over a call of `simulate`", ">= 20", fastest / own),
            ("fastest solver of diffrax over a jitted run", ">= 20", fastest / jitted),
            ("Kvaerno5 over a call of `simulate`", "", r.number("run", peer=KVAERNO5, **CHOSEN) / own),
            *(
                (f"CVODES one by one over many runs by `{way}`", ">= 200", loop / r.number("run of many", at=way))
                for way in (VMAP, GROUPS, SWEEP)
            ),
            ("Jacobian in runs", "<= 2.5", r.number("jacobian", **CHOSEN) / jitted),
            ("reverse gradient in runs", "<= 4", r.number("gradient", **CHOSEN) / jitted),
        ]

    return one, many, Targets("Ratios on the LuGre test bench.", targets)


def _ensemble() -> Table:
    return Table(
        "Many runs in one call on {device}: the Lorenz system from 0 to 1 by Tsit5 of diffrax at 1e-8 (float32: 1e-6),"
        " the LuGre test bench at 1e-4, and 12 events of the belt with Coulomb friction at 1e-6 (float32: 1e-5). Error:"
        " largest final error of 16 runs, relative for values above 1.",
        ("runs", "time of all", "first call", "runs a second", "error"), ("case", "at"),
    )  # fmt: skip


def _stick_slip(r: Recorded) -> list[tuple[str, str, float]]:
    jitted, call = r.number("run in `jax.jit`", **TIGHT), r.number("run", **TIGHT)
    scipy = [r.number("run", peer=name, **CHOSEN) for name in r.all_of("run", "peer") if name.startswith("scipy")]
    return [
        ("RK45 of SciPy over a call of `simulate`", ">= 200", r.number("run", peer="scipy RK45", **TIGHT) / call),
        (
            "fastest method of SciPy at the same error over a call of `simulate`",
            ">= 200",
            min(scipy, default=float("nan")) / call,
        ),
        ("legs in `lax.scan` over a jitted run", ">= 1", r.number("run", peer=SCANNED, **TIGHT) / jitted),
        ("a single run over a run of a batch", ">= 15", jitted / r.number(MANY[0], at=VMAP)),
    ]


def _accelerations(r: Recorded) -> list[tuple[str, str, float]]:
    def ratio(n: str, way: str, peer: str) -> float:
        return r.number(way, case=n, key="minimum") / r.number(way, case=n, peer=peer, key="minimum")

    sizes, ways = r.all_of("loop", "case"), ("loop", "many", "many in a loop")
    hand = [
        (f"over equations by hand, n = {n}, {way}", "<= 1.3", ratio(n, way, HAND)) for n in sizes[:3] for way in ways
    ]
    return hand + [(f"over MuJoCo, n = {n}, many", "< 1", ratio(n, "many", "MuJoCo")) for n in sizes if int(n) <= 6]


def _first_calls(r: Recorded) -> list[tuple[str, str, float]]:
    viscous, six = r.number("first run", case="two viscous joints"), "six LuGre joints"
    scenes = ("LuGre box", "Coulomb belt", "two LuGre joints", "two Coulomb joints", "three LuGre joints")
    asked = {"first run": (0.8, 1, 1.5, 2, 1.5), "first gradient": (2, 3, 4, 6, 5)}

    def runs(way: str, name: str) -> float:
        return r.number(way, case=name) / r.number("run", case=name)

    return [
        *(
            (f"{way} over first run of two viscous joints: {name}", f"<= {most}", r.number(way, case=name) / viscous)
            for way, limits in asked.items()
            for name, most in zip(scenes, limits, strict=True)
        ),
        *((f"reverse gradient in runs: {name}", "<= 3", runs("gradient", name)) for name in scenes[:3]),
        *((f"forward Jacobian in runs: {name}", "<= 2.5", runs("jacobian", name)) for name in scenes[:3]),
        (f"step of the default solver over a step of Tsit5: {six}", "<= 4",
         r.number("step of run", case=six) / r.number("step of run by Tsit5", case=six)),
        (f"first run [s]: {six}", "<= 6", r.number("first run", case=six)),
        (f"first gradient [s]: {six}", "<= 20", r.number("first gradient", case=six)),
    ]  # fmt: skip


def _sweep(r: Recorded) -> list[tuple[str, str, float]]:
    ours, kills, count = r.number("run", at=SWEEP), r.settings.get("kills", 0), r.settings["many"]
    processes = next(iter(r.all_of("run", "at", peer=CVODES)), "")
    return [
        ("CVODES on all cores over `sweep`", ">= 60", r.number("run", peer=CVODES, at=processes) / ours),
        ("Kvaerno5 under plain `vmap` over `sweep`", ">= 100", r.number("run", peer=KVAERNO5, at="plain vmap") / ours),
        ("the same solver under plain `vmap` over `sweep`", "", r.number("run", at="plain vmap") / ours),
        (f"{count:,} runs into a store [runs per second]", "", count / r.number("many runs into a store")),
        ("peak memory of these [GiB]", "< 2", r.number("peak memory of many runs") / 2**30),
        (f"store after {kills} kills bit-identical (1: yes)", ">= 1", r.number("same store after kills")),
    ]


def _errors(of: str) -> tuple[str, ...]:
    return f"error of {of}, largest", f"error of {of}, at the end", f"growth of the error of {of}"


REPORTS = {
    "lugre_testbench": Report("LuGre's test bench: one run, many, derivatives.", "speed", _lugre("with")),
    "lugre_testbench_untuned": Report("The same without `tune_cpu`.", "benchmarks", _lugre("without")),
    "lugre_work_precision": Report(
        "LuGre's test bench: time against error, tolerance by tolerance.", "accuracy",
        (Table("Time of one run at each rtol, medians.", ("run",), ("at",), ("peer",)),),
    ),
    "first_calls": Report(
        "Compile time of a scene and its derivatives.", "speed",
        (
            Table(
                "First calls: processor time of tracing and compilation. Warm calls of jitted functions: medians. Runs"
                " have {samples} saved times, derivatives six parameters (belt: five, the last scenes: all their"
                " numbers). With `jaxmodsim.tune_cpu()`.",
                (
                    "first run", "first gradient", "first jacobian", "equations of run", "equations of gradient",
                    "steps of run", "run", "gradient", "jacobian",
                ),
                ("case",),
            ),
            Targets("First calls and derivatives.", _first_calls),
        ),
    ),
    "pulled_spring": Report(
        "LuGre's law of 1995, pulled through a spring: error against steps, time of a run.", "accuracy",
        (
            Table(
                "LuGre friction of 1995 pulled through a spring, {t1:g} s: largest error of the friction force, whose"
                " maximum is 1.5 N. At: rtol, or the step [s] of RK4, which confirms the reference with steps of 10"
                " us.",
                ("steps", "error of F in newtons", "run"), ("peer", "at"), where={"peer": (OURS, "RK4, here")},
            ),
            Table(
                "The same with relative errors of velocity and friction force of at most 1e-6 over the run. Medians,"
                " all in one process, with `jaxmodsim.tune_cpu()`.",
                ("rtol", "steps", "error of v", "error of F", "run", "run in `jax.jit`"), where=CHOSEN,
            ),
        ),
    ),
    "stick_slip": Report(
        "A minute of stick and slip, 122 events: one run, many, gradient, compilation.", "stick_slip",
        (
            Table(
                "Belt oscillator, {t1:g} s and {events} events, at rtol 1e-6. Error of the final position against the"
                " closed form; the amplitude is 0.03 m. Medians, all in one process, with `jaxmodsim.tune_cpu()`.",
                ("error of x", "run", "run in `jax.jit`"), where=TIGHT,
            ),
            Table(
                "The same at the loosest tolerance with an error at most that of jaxmodsim. Reverse gradient with"
                " respect to Fc, Fs, k, m and vb. Run: a call of `simulate`.",
                ("rtol", "run", "gradient", "error of the gradient"), where=CHOSEN,
            ),
            Table("{runs} runs with different parameters, error of the final position.", MANY, ("peer", "at")),
            Table("Time to trace and compile.", ("compilation", "compilation of the gradient")),
            Targets("Stick-slip: time of the other program over ours.", _stick_slip),
        ),
    ),
    "accelerations": Report(
        "Accelerations of a chain of n links: in a loop, and many at once.", "accelerations",
        (
            Table(
                "Time of one evaluation for n links: minimum of interleaved repetitions, all in one process, with"
                " `jaxmodsim.tune_cpu()`. By hand: the faster of arrays and scalars. Loop: dependent evaluations with a"
                " step of Euler. Many: 1024 states in one call, of MuJoCo on all cores.",
                ("loop", "many", "many in a loop"), ("case",), ("quantity", "peer"), shown="minimum",
            ),
            Targets("Accelerations: time of jaxmodsim over that of the other program.", _accelerations),
        ),
    ),
    "long_runs": Report(
        "Energy, momentum and motion over 100 000 periods.", "long_runs",
        (
            Table(
                "Spherical pendulum, {periods} periods of {period:.2f} s: relative errors of the energy and of the"
                " angular momentum about the vertical, error of the angle phi against its closed form. Growth: exponent"
                " of time over the last two decades, unless the error exceeds the swing of {swing:.2f} rad. One run"
                " each.",
                ("steps", "run", *_errors("energy"), _errors("momentum")[0], *_errors("phi")[1:]),
                where={"case": "spherical pendulum", "at": ""},
            ),
        ),
    ),
    "hard_cases": Report(
        "Hard cases in this and in other programs.", "hard_cases",
        (
            Table(
                "Number of hard cases by outcome. diffrax and SciPy: `Fc sign(v)` for dry friction, rtol {rtol:g}, atol"
                " {atol:g}; Kvaerno5 for high rates. The admissible error is the tolerance of the case for `jaxmodsim`,"
                " and {generous:g} times that, at least {least:g}, for the others. Where a case has no answer, any"
                " error message counts as right. No answer: after {limit:g} s, compilation included.",
                ("cases",), columns=("at",),
            ),
            Table("Case by case.", ("verdict",), ("case",), ("peer",)),
        ),
    ),
    "derivative_modes": Report(
        "Reverse mode against forward mode: derivatives of the same steps.", "limits",
        (
            Table(
                "Difference between reverse and forward mode, which may differ by rounding only: relative to the"
                " derivative, or to result over parameter if that is larger. Named problems with respect to all numbers"
                " of their scenes, at rtol 1e-6, 1e-9 and 1e-12; hard cases (stiffness, rest and reversal, many events,"
                " gradients) with respect to theirs. Tuned: with `jaxmodsim.tune_cpu()`.",
                ("derivatives", "median", "largest", "above 1e-11"), ("case", "at"),
            ),
            Table("Differences above {shown:g}.", ("difference", "why it is hard"), ("case", "at")),
        ),
    ),
    "ensemble": Report("Ensembles on the processor, in both precisions.", "sweeps", (_ensemble(),)),
    "ensemble_gpu": Report("The same ensembles on a GPU.", "sweeps", (_ensemble(),)),
    "sweep": Report(
        "Many runs: on all cores, into a store, killed and resumed.", "sweeps",
        (
            Table(
                "{runs} runs of the LuGre test bench with different parameters, {t1:g} s each, interleaved; error of"
                " the final velocity. Tolerance: the loosest with an error of the nominal run of at most 1e-6. With"
                " `jaxmodsim.tune_cpu()`.",
                ("rtol", "run", "error"), ("peer", "at"),
            ),
            Targets("Sweeps: ratios of times, unless a unit is given.", _sweep),
        ),
    ),
    "behaviour": Report(
        "Friction laws in the standard experiments.", "laws",
        (
            Table("Quantities of the experiments, and their limits.", ("number", "unit", "limit"), ("case",)),
            Table(
                "Whether each law keeps the limit of each experiment, with its value; **no**: a known limitation.",
                ("verdict",), columns=("case",),
            ),
        ),
    ),
    "friction_models": Report(
        "Friction models on the test bench.", "laws",
        (Table(
            "A box of 2 kg under a force that rises by 1 N/s unless the name says otherwise, 10 s. Break-away: from"
            " then on friction is at least 0.05 N below the applied force.",
            ("break-away", "zero crossings", "steps", "run", "ending"), ("peer", "case"),
        ),),
    ),
    "bouncing_ball": Report(
        "A ball bounces to rest: events, compliant contacts, MuJoCo.", "theory",
        (Table(
            "A ball dropped from 1 m, e = 1/2: height after {bouncing} s, between bounces, and its derivative with"
            " respect to the initial height; height and energy after {rest} s, at rest, both zero in closed form. At:"
            " rtol, or the step h [s], with springs whose contacts take 0.2 sqrt(h) seconds.",
            ("error of the height", "error of its derivative", "height at rest", "energy at rest", "run"),
            ("peer", "at"),
        ),),
    ),
    "fmu": Report(
        "Scenes as FMUs in FMPy: errors against `simulate`, and the time of a step.", "howto/fmu",
        (Table(
            "Five scenes as FMUs in FMPy at rtol {rtol:g}, against `simulate` at 1e-10: largest error of the"
            " coordinates in co-simulation and in model exchange (by CVODE of FMPy), and of event times in"
            " co-simulation; median time of a step of 1 ms, the call from Python included; processor time"
            " to write the FMU, compilation excluded. Events of an FMU include changes of a guide's side.",
            ("error of coordinates", "events", "events of the run", "error of event times", "step of 1 ms", "export"),
            ("case", "at"),
        ),),
    ),
    "shoulder_joint": Report(
        "A joint with stiction under PID control: hunting, and a ramp with friction compensated.",
        "howto/compensate_friction",
        (
            Table(
                "Hunting of a geared shoulder joint with a break-away of {Fs:g} N m, whose friction falls by {slope:g}"
                " N m s/rad near rest, kp {kp:g} N m/rad, ki {ki:g} N m/(rad s): the limit cycle by `continue_orbits`"
                " and by SciPy, slip by slip; zero: the errors vanish. The last two values of kd are 5 % below and"
                " above the closed form.",
                ("amplitude", "period"), ("at",), ("quantity", "peer"), where={"case": "limit cycle"},
            ),
            Table(
                "Damping at which the limit cycle vanishes: extrapolated from the branch to zero amplitude, and in"
                " closed form.",
                ("damping without hunting",), where={"case": "vanishing"},
            ),
            Table(
                "A ramp of {speed:g} mrad/s with kd {kd:g} N m s/rad, gravity compensated, after the first fifth of"
                " 10 s. At: compensated friction over friction. Stair: largest step between two sticks.",
                ("stair", "tracking error", "over-compensation"), ("at",), where={"case": "ramp"},
            ),
        ),
    ),
    "periodic_orbit": Report(
        "Periodic orbits by shooting, and by simulations that settle.", "orbits",
        (Table(
            "Quantities with closed forms, by `periodic_orbit` and by the end of a simulation. rtol {rtol:g}. Den"
            " Hartog's oscillator at {W:g} rad/s, with mass, stiffness and amplitude of the force 1. At: duration of"
            " the simulation from rest, which `periodic_orbit` also starts with.",
            ("error", "run"), ("case", "peer", "at"),
        ),),
    ),
    "conformance": Report(
        "Public cases of others: published figures, references, derivatives, other programs.", "conformance",
        (
            Table(
                "Largest errors over the outputs of a case, in their units, against the independent reference. Event"
                " times: largest error; events: number that agree in order, of those in our run if it has more."
                " Derivatives: largest difference from central differences of the reference, relative to the largest"
                " derivative. Run with derivatives: a warm call.",
                (
                    "error of the published values", "error of ours", "events", "error of event times in seconds",
                    "published modes", "error of derivatives", "run with derivatives",
                ),
                ("case",),
            ),
            Table("Outputs at the end.", ("published", "reference", "ours"), ("case", "at")),
            Table(
                "Derivatives of the first output.", ("difference of the reference", "our derivative"), ("case", "at"),
            ),
            Table(
                "Task 1: derivatives of the height by height, velocity and the force in the first of 480 steps.",
                ("derivative",), ("at",), ("peer",), where={"case": "task 1"},
            ),
            Table(
                "Task 2: distance from the target at the end of each program's optimisation, by the closed form."
                " Others: 1000 iterations. Here: Newton's method.",
                ("distance from the target", "runs"), where={"case": "task 2"},
            ),
            Table(
                "Task 3: loss at the end of each program's optimisation. Others: 1000 iterations. Here: BFGS. The least"
                " loss over all controls is {least}; a lower one is an error of discretisation.",
                ("loss", "loss above the least", "runs"), where={"case": "task 3"},
            ),
            Table(
                "Five cases in other programs: largest error of the outputs, and the time of one run, medians. At:"
                " rtol, or the step of MuJoCo [s]. SciPy runs legs with terminal events, in an order written by hand."
                " Contacts of MuJoCo are springs and dampers of ten steps or more. Their restitution depends on where"
                " in a step the impact falls, an error that does not fall with the step, but with the number of steps.",
                ("error", "run"), ("case", "peer", "at"),
            ),
            Table("Sources, and what differs.", ("source", "published results", "remark"), ("case",)),
        ),
    ),
    "measured_axis": Report(
        "`jaxmodsim fit` on a measured axis.", "measured_record",
        (
            Table(
                "EMPS record, {samples:,} samples, open-loop error of the position over the whole record, and in four"
                " parts held out one after the other. Target: {goal} mm with at most 8 parameters. One command,"
                " {seconds} s.",
                (
                    "parameters", "RMSE", "RMSE with 5 steps a sample", "held-out error", "standard error",
                    "not determined",
                ),
            ),
            Table(
                "Thirds of the record, each predicted by a fit to the other two as two records: error, expected error,"
                " half width of the 90 % band, and share of the samples in it.",
                ("error", "expected error", "half band", "samples in the band"), ("peer", "at"),
            ),
        ),
    ),
    "servo": Report(
        "`jaxmodsim fit --axis servo` on nine measured records of a servo.", "servo",
        (
            Table(
                "Mean absolute errors of the angle, {samples:,} samples in nine records: fitted to all, with one of"
                " three trajectories left out, with one of three gains left out; at gain 100, 200 and 400 with the"
                " trajectory left out, beside those of the published parameters over four trajectories. Target: below"
                " {goal} mrad with the trajectory left out. All laws in one command, {seconds} s; at most {evaluations}"
                " evaluations of the gradient for the seven fits of a law.",
                ("parameters", "fitted", "trajectory left out", "gain left out", "gain 100", "gain 200", "gain 400"),
            ),
            Table(
                "Records predicted by the commands, with the law chosen above fitted to the records of other"
                " trajectories, or of other gains: mean absolute error, half width of the 90 % band, and share of the"
                " samples in it.",
                ("error", "half band", "samples in the band"), ("case",), ("quantity", "at"),
            ),
        ),
    ),
    "new_records": Report(
        "Coverage of the bands of a fit for another record.", "identification",
        (
            Table(
                "{pairs} synthetic pairs of records of an axis with LuGre friction, which varies by 5 % with position."
                " Its level differs by 0 to {largest:g} % (random). Folds of the first record choose the law; errors"
                " and samples within 90 % bands are those of the second.",
                ("samples in the band", "within 10 % of the best", "median error"), ("case",), ("quantity", "at"),
            ),
        ),
    ),
    "coverage": Report(
        "Coverage of 95 % confidence intervals.", "identification",
        (Table(
            "Share of {repeats} repeats whose 95 % interval contains the truth; starts wrong by up to a factor of ten.",
            ("share", "converged", "time"), ("case",), ("quantity", "at"),
        ), Table(
            "Fits with default options and an unknown start of the record. Held: share of {repeats} repeats whose 95 %"
            " interval contains the truth. Remark: share that report a constant offset of the sensor;"
            " in the last column also those whose intervals all hold.",
            ("held", "warning on an offset", "warning, or all hold"), ("case",), ("quantity", "at"),
        )),
    ),
}  # fmt: skip
