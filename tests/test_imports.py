"""The house has floors: imports point one way only, and every new module is given its place."""

import ast
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Which part may import which other ones. Environments, losses, collectors and networks know nothing
# of each other: what they share are TensorDict keys.
PARTS = {
    "extras": (),
    "files": (),
    "processes": (),
    "processor": (),
    "naming": (),
    "lazy": (),
    "ranges": (),
    "targets": ("naming",),
    "parameters": ("ranges", "targets"),
    "envs": ("extras", "lazy", "naming", "processes", "ranges", "targets"),
    "objectives": ("naming", "ranges"),
    "collectors": ("extras", "files", "naming", "processes", "ranges"),
    "models": ("processor", "ranges"),
    "algorithms": (
        *("collectors", "models", "naming", "objectives", "processor", "ranges", "targets"),
    ),
    "runs": ("algorithms", "extras", "files", "ranges", "targets"),
    "training": ("algorithms", "collectors", "files", "runs", "targets"),
    "scores": (),
    "evaluation": (
        *("algorithms", "collectors", "extras", "files", "lazy", "models", "naming", "parameters"),
        *("ranges", "runs", "scores"),
    ),
    "reporting": ("extras", "files", "runs", "scores"),
    "cli": (
        *("algorithms", "envs", "evaluation", "extras", "files", "naming", "parameters"),
        *("processes", "ranges"),
        *("reporting", "runs", "scores", "targets", "training"),
    ),
    "evaluate": ("cli",),
    "export": ("cli",),
    "report": ("cli",),
    "__main__": ("cli", "naming"),
    "train": ("cli",),
}

# Inside a package a module may import those of the floors below its own.
FLOORS = {
    "envs": (
        ("errors", "opengl", "rng", "physics"),
        ("costs", "physics.batch", "physics.dynamics", "physics.warp_kernels", "pictures"),
        ("physics.warp_physics",),
        ("contract",),
        ("simulated",),
        # Safety Gym: records, then tables of rules, then worlds, and what is seen of them.
        ("safety_gym.config_values", "safety_gym.geometry"),
        ("safety_gym.config_keys",),
        ("safety_gym.config",),
        ("safety_gym.world",),
        ("safety_gym.robots", "safety_gym.tasks"),
        ("safety_gym.costs", "safety_gym.elements", "safety_gym.readings"),
        ("safety_gym.bodies", "safety_gym.layouts", "safety_gym.state", "safety_gym.suite"),
        ("safety_gym.building", "safety_gym.draws"),
        ("safety_gym.display", "safety_gym.lidar"),
        ("safety_gym.observations", "safety_gym.renderer", "safety_gym.warp_backend"),
        ("safety_gym.env",),
        ("safety_gym", "extending"),
        # The velocity family: rows, configurations, then functions over tensors, the environment.
        ("physics.runge_kutta", "velocity.runners"),
        ("velocity.velocity_config",),
        ("velocity.locomotion",),
        ("velocity.runner_model",),
        ("velocity.velocity_env",),
        ("velocity",),
        # The table of families, and environments of other libraries.
        ("families",),
        ("gymnasium.env_wrappers", "gymnasium.world_arrays"),
        ("gymnasium.gymnasium_env", "gymnasium.gymnasium_interfaces"),
        ("gymnasium.conversion",),
        ("gymnasium",),
        ("torchrl.step_entries",),
        ("torchrl.torchrl_env",),
        ("torchrl",),
        # What changes any of them from outside.
        ("transforms.base",),
        ("transforms.action_transforms", "transforms.observation_transforms"),
        ("transforms.reward_transforms",),
        ("transforms.environment",),
        ("transforms",),
        ("making",),
        ("registration",),
        ("",),
    ),
    "objectives": (
        ("distributions", "samples", "cpo_dual", "risk", "violation"),
        ("episode_costs", "gae"),
        ("advantages", "critics", "limits", "multipliers", "q_functions", "trust_region"),
        ("controllers", "cost_critics", "surrogate", "fisher"),
        ("actor_critic", "policy_losses", "policy_projections", "sac"),
        ("cal", "deterministic_losses", "penalties", "wcsac"),
        ("",),
    ),
    "collectors": (
        ("accounting", "recording", "workers"),
        ("datasets", "factory"),
        ("",),
    ),
    "models": (
        ("action_distributions", "input_scales"),
        ("heads",),
        ("bounded_actors", "networks", "q_networks"),
        ("collecting_policies", "encoders"),
        ("build_networks",),
        ("",),
    ),
    "algorithms": (
        ("algorithm_contract", "constraints", "losses", "processor_use"),
        ("minibatch", "replay_buffer", "trust_region_step"),
        ("build_part", "cpo_step", "recovery_steps"),
        ("off_policy_networks", "replay_update"),
        ("dataset",),
        ("off_policy", "on_policy", "torchrl_trainers"),
        ("",),
    ),
    "runs": (
        ("checkpoint_file", "folder", "outcome"),
        ("checkpoints", "curves", "display", "identity", "loggers", "table"),
        ("record",),
        ("",),
    ),
    "training": (
        ("candidates", "state"),
        ("trainer",),
        ("building",),
        ("",),
    ),
    "scores": (
        ("benchmark", "bounds", "comparisons"),
        ("certificate", "measures"),
        ("",),
    ),
    "cli": (
        ("",),
        ("grammar",),
        ("run_folders", "user_code"),
        ("schema", "sweeps"),
        ("suggestions",),
        ("composing",),
        ("certificates", "report"),
        ("session",),
        ("evaluating", "train"),
        ("evaluate", "trained_run"),
        ("export",),
        ("python_api",),
    ),
    "evaluation": (
        ("episodes", "loading", "settings"),
        ("certifying", "policies", "video"),
        ("measuring",),
        ("variations",),
        ("",),
    ),
    "reporting": (
        ("tables",),
        ("archive", "notes"),
        ("recorded",),
        ("experiments",),
        ("inventory", "scoring"),
        ("slates",),
        ("figures",),
        ("curves",),
        ("page",),
        ("",),
    ),
}

# Libraries that only these parts know.
LIBRARIES = {
    "mujoco": ("envs",),
    "gymnasium": ("envs",),
    "matplotlib": ("runs", "reporting"),
}


@dataclass(frozen=True)
class Import:
    """One import statement's module, as seen from the module that it stands in."""

    importer: str
    imported: str

    def __str__(self) -> str:
        return f"{self.importer} imports {self.imported}"


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


PATHS = {module_name(path): path for path in (*ROOT.glob("safe_rl/**/*.py"), ROOT / "train.py")}


def imports_of(module: str) -> list[Import]:
    """Every import of a module, also those inside functions and under `if TYPE_CHECKING`."""
    tree = ast.parse(PATHS[module].read_text())
    found = []
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide where they point"
            # `from package import module` imports the module.
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [name if name in PATHS else str(node.module) for name in full]
        found += [Import(module, name) for name in dict.fromkeys(names)]
    return found


def part_of(module: str) -> str:
    """The package or top-level module of safe_rl that a module is in, or `train`."""
    return [*module.split("."), ""][module.startswith("safe_rl")]


def floor_of(module: str) -> int:
    part = part_of(module)
    inside = module.removeprefix(f"safe_rl.{part}").removeprefix(".")
    floors = [number for number, modules in enumerate(FLOORS[part]) if inside in modules]
    assert floors, f"give {module} a floor in FLOORS"
    return floors[0]


INSIDE = [module for module in PATHS if part_of(module)]


@pytest.mark.parametrize("module", INSIDE)
def test_imports_point_one_way(module):
    part = part_of(module)
    assert part in PARTS, f"give {part} a row in PARTS"
    floor = floor_of(module) if part in FLOORS else 0
    for found in imports_of(module):
        if found.imported not in PATHS:
            library = found.imported.split(".")[0]
            assert part in LIBRARIES.get(library, (part,)), str(found)
        elif part_of(found.imported) != part:
            assert part_of(found.imported) in PARTS[part], str(found)
        else:
            assert floor_of(found.imported) < floor, str(found)


def test_the_package_itself_imports_what_comes_before_torch_and_no_part():
    """So that importing one part never pulls in another: the way in is found when asked for."""
    tree = ast.parse(PATHS["safe_rl"].read_text())
    at_once = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    assert [ast.unparse(node) for node in at_once] == [
        "from typing import TYPE_CHECKING",
        "import safe_rl.processor",
        "from safe_rl.lazy import import_later",
    ]
    at_hand = {"typing", "safe_rl.processor", "safe_rl.lazy"}
    later = {found.imported for found in imports_of("safe_rl")} - at_hand
    assert later == {"safe_rl.cli.python_api", "safe_rl.envs"}


def in_a_process(code, **environment):
    """Run code in a process of its own; returns what it says."""
    clean = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    result = subprocess.run(
        [sys.executable, "-c", code],
        env=clean | environment, capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return result.stdout + result.stderr


def test_the_package_is_imported_in_no_time_and_without_torch():
    said = in_a_process(
        "import sys, time; start = time.process_time(); import safe_rl\n"
        "print(time.process_time() - start, 'torch' in sys.modules)"
    )
    seconds, has_torch = said.split()
    assert float(seconds) < 0.05
    assert has_torch == "False"


OPENMP_SAYS = {"OMP_DISPLAY_ENV": "verbose"}  # libgomp prints its settings when it is loaded


@pytest.mark.long
def test_idle_threads_sleep_if_the_package_comes_first():
    said = in_a_process("import safe_rl, torch; torch.ones(9) + 1", **OPENMP_SAYS)
    assert "GOMP_SPINCOUNT = '0'" in said
    assert "import safe_rl first" not in said


@pytest.mark.long
def test_torch_first_is_said_to_be_too_late():
    said = in_a_process("import torch\nimport safe_rl", **OPENMP_SAYS)
    assert "GOMP_SPINCOUNT = '0'" not in said
    assert "UserWarning: torch was imported before safe_rl" in said
    assert said.count("import safe_rl first") == 1


@pytest.mark.long
@pytest.mark.parametrize("setting", [{"OMP_WAIT_POLICY": "ACTIVE"}, {"GOMP_SPINCOUNT": "10"}])
def test_a_setting_of_the_users_is_kept_without_a_word(setting):
    code = "import torch, safe_rl, os; print(os.environ.get('OMP_WAIT_POLICY'))"
    assert in_a_process(code, **setting).strip() == setting.get("OMP_WAIT_POLICY", "None")


def test_tables_have_no_circles_and_no_ruins():
    for part, allowed in PARTS.items():
        above = list(PARTS)[: list(PARTS).index(part)]
        assert set(allowed) <= set(above), f"{part} must stand below what it imports"
        assert any(part_of(module) == part for module in PATHS), f"{part} is no more"
    for part, floors in FLOORS.items():
        modules = [f"safe_rl.{part}.{name}".rstrip(".") for floor in floors for name in floor]
        assert len(set(modules)) == len(modules)
        assert set(modules) <= set(PATHS), "modules that are no more"


@pytest.mark.long
@pytest.mark.parametrize(
    ("modules", "unneeded"),
    [
        # a fifth of the seconds in which a run begins
        (("training.building",), {"matplotlib", "scipy.optimize", "scipy.stats"}),
    ],
)
def test_what_is_not_needed_yet_is_not_imported(modules, unneeded):
    said = in_a_process(
        f"import sys, {', '.join(f'safe_rl.{module}' for module in modules)}\n"
        f"print({unneeded} & sys.modules.keys())"
    )
    assert said == "set()\n"


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        ("train", ("--help",), "PointGoal1"),
        ("train", ("--cfg", "job"), "PointGoal1"),
        ("evaluate", ("--help",), "episodes=100"),
        ("evaluate", ("runs/0", "episode=3"), "episodes"),
    ],
)
def test_help_and_configurations_are_shown_without_importing_what_trains(command, arguments, words):
    """Which takes longer than all the rest of it."""
    said = in_a_process(
        "import sys; sys.stderr = sys.stdout\n"
        f"from safe_rl.cli.{command} import main; sys.argv[1:] = {arguments}\n"
        "try: main()\n"
        "finally: print('slow:', {'torch', 'matplotlib'} & sys.modules.keys())"
    )
    assert words in said
    assert said.splitlines()[-1] == "slow: set()"
