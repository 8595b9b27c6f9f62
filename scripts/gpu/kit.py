#!/usr/bin/env python3
"""Checks and times Fathom on a machine with a GPU. Needs no Rust, no network and no installation.

    run                    all parts, checks first; what does not fit into the limit is left for the next call
    run checks|times|peers the parts of one kind, in any order of calls
    run PART...            these parts; `run list` prints them
      --limit SECONDS      ends before this time, default 570
      --out FOLDER         results (default: `results` beside this program); a part that has one is not run again
      --allow-cpu          goes on without a GPU

It writes after each part, so that an interrupted call loses one part at most:
    rows.jsonl   a row for each result, for `scripts/gpu.sh unpack`
    parts.json   what became of each part
    log.txt      the output of every command
    trace.json   parts, device time of stages, load and memory of the GPU; for ui.perfetto.dev
"""

import argparse
import datetime
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Bytes a second that the vendor names for the memory of a card, in 1e9; the first name that fits counts.
PEAK_BANDWIDTH = {"GH200": 4000, "H200": 4800, "H100 PCIe": 2039, "H100 NVL": 3938, "H100": 3350, "A100-SXM4-80": 2039,
                  "A100 80": 1935, "A100": 1555, "L40S": 864, "RTX 4090": 1008, "RTX 3090": 936}
# Kernels of Fathom and stages of gsplat that do the same work. Fathom's other kernels are those of the tiles.
# Of gsplat's two forms of Adam, the faster one counts.
COMPARED = {
    "project": ({"cull", "project_forward"}, (
        "activations_forward", "harmonics_concatenation_forward", "projection_forward", "harmonics_forward")),
    "tiles": (set(), ("intersect_and_sort", "tile_offsets")),
    "rasterize": ({"rasterize_forward"}, ("rasterize_forward",)),
    "rasterize backward": ({"rasterize_backward"}, ("rasterize_backward",)),
    "project backward, Adam": ({"project_backward", "project_backward_f32"}, (
        "harmonics_backward", "harmonics_concatenation_backward", "projection_backward", "activations_backward")),
}
ADAM = "project backward, Adam", ("adam_fused", "adam_selective")


class Failed(Exception):
    """A part has no result; the text says why. `out` is what a command had written."""

    def __init__(self, why, out=""):
        super().__init__(why)
        self.out = out


class Kit:
    """Where things are, what is measured, and what came of it."""

    def __init__(self, out, limit, allow_cpu):
        self.settings = json.loads((HERE / "kit.json").read_text())
        self.out, self.limit, self.allow_cpu = out, limit, allow_cpu
        self.begin = time.monotonic()
        # Beside the results, which are few and small.
        self.work = HERE / "work"
        self.work.mkdir(parents=True, exist_ok=True)
        self.environment = dict(os.environ)
        self.adapter, self.is_cpu = None, False
        self.events = []
        self.background = {}
        self.sampler = Sampler(self)
        self.parts = self.read("parts.json", {})

    def read(self, name, otherwise):
        try:
            return json.loads((self.out / name).read_text())
        except (OSError, ValueError):
            return otherwise

    def left(self):
        return self.limit - (time.monotonic() - self.begin)

    def say(self, text):
        line = f"{time.monotonic() - self.begin:6.1f} s  {text}"
        print(line, flush=True)
        self.log(line)

    def log(self, text):
        with open(self.out / "log.txt", "a", encoding="utf-8", errors="replace") as file:
            file.write(text.rstrip("\n") + "\n")

    def run(self, *command, seconds=120, environment=None):
        """The standard output of a command. Its process group is killed after `seconds`, or at the limit."""
        command = [str(word) for word in command]
        seconds = max(1.0, min(seconds, self.left() - 5))
        self.log("$ " + " ".join(command))
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace",
                                   cwd=self.work, env={**self.environment, **(environment or {})},
                                   start_new_session=True)
        try:
            out, err = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
            self.log(out + err)
            raise Failed(f"{Path(command[0]).name} was stopped after {seconds:.0f} s", out) from None
        except KeyboardInterrupt:
            os.killpg(process.pid, signal.SIGKILL)
            raise
        self.log(out + err)
        if process.returncode != 0:
            last = (err.strip() or out.strip() or "no output").splitlines()[-1]
            raise Failed(f"{Path(command[0]).name} failed ({process.returncode}): {last}", out)
        return out

    def program(self, name, *arguments, **more):
        return self.run(HERE / "bin" / name, *arguments, **more)

    def row(self, figure, scene, variant, command, values, note=""):
        """A row in the form of bench/history.jsonl."""
        row = {"date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
               "commit": self.settings["commit"], "figure": figure, "scene": scene, "variant": variant,
               "command": command, "adapter": self.adapter or "none",
               # Such figures say nothing about a GPU.
               "settings": {"rehearsal": True} if self.settings["rehearsal"] or self.is_cpu else {},
               "values": {key: value for key, value in values.items() if value is not None}, "note": note}
        with open(self.out / "rows.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps({key: value for key, value in row.items() if value not in (None, "", {})}) + "\n")
        numbers = (f"{key} {value:.4g}" for key, value in row["values"].items() if isinstance(value, (int, float)))
        self.say(f"{figure} {scene} {variant or ''}: " + (", ".join(numbers) or note))

    def trace(self, name, begin, seconds, thread):
        self.events.append({"name": name, "ph": "X", "ts": begin * 1e6, "dur": seconds * 1e6, "pid": 1, "tid": thread})

    def now(self):
        """Seconds since the epoch, so that the traces of two calls lie one behind the other."""
        return time.time()

    def write_trace(self):
        with open(self.out / "trace.json", "w", encoding="utf-8") as file:
            json.dump({"traceEvents": self.events}, file)


class Sampler(threading.Thread):
    """Asks nvidia-smi for memory, load, clock and power while a part runs."""

    FIELDS = ("memory.used", "utilization.gpu", "clocks.sm", "power.draw")

    def __init__(self, kit):
        super().__init__(daemon=True)
        self.kit, self.peak, self.ended = kit, 0.0, threading.Event()

    def run(self):
        if not shutil.which("nvidia-smi"):
            return
        query = ["nvidia-smi", f"--query-gpu={','.join(self.FIELDS)}", "--format=csv,noheader,nounits"]
        while not self.ended.wait(0.25):
            try:
                text = subprocess.run(query, capture_output=True, text=True, timeout=10, check=True).stdout
                texts = text.splitlines()[0].split(",")
            except (OSError, IndexError, subprocess.SubprocessError):
                continue
            for name, text in zip(self.FIELDS, texts):
                try:
                    value = float(text)
                except ValueError:
                    continue  # [N/A]
                if name == "memory.used":
                    self.peak = max(self.peak, value)
                self.kit.events.append({"name": name, "ph": "C", "ts": self.kit.now() * 1e6, "pid": 1,
                                        "args": {name: value}})

    def peak_bytes(self):
        """The most memory of the card in use since the part began, all programs together; None if unknown."""
        return self.peak * 2**20 if self.peak else None


# --- Finding the GPU ---------------------------------------------------------------------------------

def icd_files():
    """Descriptions of Vulkan drivers on this machine, GPUs before CPUs."""
    folders = ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d",
               "/usr/local/nvidia/share/vulkan/icd.d", "/usr/local/nvidia/vulkan/icd.d", "/opt/amdgpu/etc/vulkan/icd.d"]
    found = [file for folder in folders for file in sorted(Path(folder).glob("*.json"))]
    return sorted(found, key=lambda file: file.name.startswith("lvp"))


def libraries():
    """Names that the system's loader finds."""
    for program in ("ldconfig", "/sbin/ldconfig"):
        try:
            text = subprocess.run([program, "-p"], capture_output=True, text=True, check=True).stdout
            return set(re.findall(r"^\s+(\S+) ", text, re.MULTILINE))
        except (OSError, subprocess.SubprocessError):
            continue
    return set()


def own_icds(folder):
    """Descriptions for a driver of NVIDIA that came without one, as in many containers."""
    files = []
    for name in ("libGLX_nvidia.so.0", "libEGL_nvidia.so.0"):
        file = folder / f"{name.split('.')[0]}.json"
        file.write_text(json.dumps({"file_format_version": "1.0.0",
                                    "ICD": {"library_path": name, "api_version": "1.3.0"}}))
        files.append(file)
    return files


def find_gpu(kit):
    """Sets the environment in which the programs find the loader and the driver."""
    have = libraries()
    lacking = [file for file in sorted((HERE / "lib").glob("*.so*")) if file.name not in have]
    folder = kit.work / "lib"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for file in lacking:
        (folder / file.name).symlink_to(file)
    paths = [str(folder), *(path for path in ("/usr/local/nvidia/lib64", "/usr/lib64-nvidia") if Path(path).is_dir())]
    kit.environment["LD_LIBRARY_PATH"] = ":".join([*paths, *filter(None, [os.environ.get("LD_LIBRARY_PATH")])])
    kit.environment["FATHOM_TEST_REQUIRE_GPU"] = "1"
    named = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    tries = [named] if named else [None, *map(str, [*icd_files(), *own_icds(kit.work)])]
    seen = []
    for files in tries:
        environment = {"VK_DRIVER_FILES": files, "VK_ICD_FILENAMES": files} if files else {}
        try:
            adapters = json.loads(kit.program("fathom", "doctor", "--json", environment=environment, seconds=60))["adapters"]
        except (Failed, ValueError, KeyError) as error:
            kit.log(f"driver {files or 'of the system'}: {error}")
            continue
        seen += [(files, adapter) for adapter in adapters]
        if any(not adapter["is_cpu"] for adapter in adapters):
            break
    gpus = [(files, adapter) for files, adapter in seen if not adapter["is_cpu"]]
    if not gpus and not (kit.allow_cpu and seen):
        drivers = ", ".join(str(files) for files in tries if files) or "none"
        raise Failed(f"no GPU was found by Vulkan (drivers tried: {drivers}); set VK_DRIVER_FILES to the JSON file of "
                     "the driver, or measure on the CPU with --allow-cpu")
    files, adapter = (gpus or seen)[0]
    if files:
        kit.environment.update(VK_DRIVER_FILES=files, VK_ICD_FILENAMES=files)
    kit.is_cpu = adapter["is_cpu"]
    kit.adapter = f"{adapter['name']} ({adapter['driver']})"
    kit.say(f"adapter: {kit.adapter}, driver file {files or 'of the system'}")


# --- Checks ------------------------------------------------------------------------------------------

def tests(kit, name, seconds):
    """Runs a test program; a failure of some tests is a result too."""
    arguments = kit.settings.get(f"{name}_filter", [])
    try:
        out, failed = kit.program(name, *arguments, seconds=seconds), ""
    except Failed as error:
        out, failed = error.out, str(error)
    counts = re.findall(r"(\d+) passed; (\d+) failed", out)
    if not counts:
        raise Failed(failed or "no test ran")
    passed, bad = map(int, counts[-1])
    names = re.findall(r"^test (\S+) \.\.\. FAILED", out, re.MULTILINE)
    kit.row("gpu_checks", "none", name, f"run {name}", {"passed": passed, "failed": bad}, ", ".join(names))
    if bad or failed:
        raise Failed(f"{bad} tests fail: {', '.join(names) or failed}")


def kernels(kit):
    tests(kit, "kernels", 300)


def device(kit):
    tests(kit, "device", 90)


def first(kit):
    """Picture and gradients of one iteration beside those of a CPU driver, which travelled with the kit."""
    file = kit.work / "first.bin"
    kit.program("first_iteration", "write", file)
    said = kit.program("first_iteration", "compare", HERE / "first.bin", file)
    apart = [float(number) for number in re.findall(r": ([0-9.e+-]+) of", said)]
    kit.row("gpu_checks", "random", "first", "first_iteration compare", {"largest_difference": max(apart)}, said.strip().replace("\n", "; "))


def small_scene(kit):
    scene = kit.work / "small"
    if not (scene / "sparse").is_dir():
        shutil.rmtree(scene, ignore_errors=True)
        kit.program("fathom", "synth", scene, "--views", 24, "--size", "96x72", "--seed", 5)
    return scene


def bytes_again(kit):
    """A short training twice, and once stopped and resumed."""
    settings = ["--allow-cpu", "--iterations", kit.settings["short_iterations"], "--max-gaussians", 3000, "--seed", 3]
    scene, digests = small_scene(kit), []
    for name in ("once", "again"):
        shutil.rmtree(kit.work / name, ignore_errors=True)
        kit.program("fathom", "train", scene, "-o", kit.work / name, *settings)
    resumed = stopped_and_resumed(kit, scene, settings)
    for name in ("once", "again", *(["resumed"] if resumed else [])):
        digests.append((kit.work / name / "model.ply").read_bytes())
    same = all(model == digests[0] for model in digests)
    psnr = json.loads(kit.program("fathom", "eval", kit.work / "once", "--json"))["psnr"]
    kit.row("gpu_checks", "synth", "bytes", "fathom train, twice and resumed", {"same_bytes": int(same), "runs": len(digests), "resumed_from": resumed, "psnr": psnr},
            "" if resumed else "no run was stopped in its middle")
    if not same:
        raise Failed("runs with one seed on one device have different models")


def stopped_and_resumed(kit, scene, settings):
    """The iteration at which a stopped run went on; None if every run ended, or was stopped too early."""
    into = kit.work / "resumed"
    for after in (4.0, 3.0, 2.0, 1.0, 0.5):
        shutil.rmtree(into, ignore_errors=True)
        command = [str(word) for word in (HERE / "bin/fathom", "train", scene, "-o", into, *settings)]
        process = subprocess.Popen(command, env=kit.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(after)
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            raise Failed("a training does not stop on Ctrl-C") from None
        if not (into / "model.ply").exists() and into.exists():
            kit.program("fathom", "train", scene, "-o", into, *settings, "--resume")
            tasks = json.loads((into / "run.json").read_text())["tasks"]
            if resumed := max(task["resumed_from_iteration"] for task in tasks):
                return resumed
    return None


def validation(kit):
    """A short training under the Khronos validation layer."""
    library = HERE / "layer/libVkLayer_khronos_validation.so"
    if not library.exists():
        raise Failed("the kit was packed without the validation layer")
    layer, log = kit.work / "layer", kit.work / "validation.txt"
    layer.mkdir(exist_ok=True)
    log.unlink(missing_ok=True)
    (layer / "VkLayer_khronos_validation.json").write_text(json.dumps({
        "file_format_version": "1.1.2",
        "layer": {"name": "VK_LAYER_KHRONOS_validation", "type": "GLOBAL", "library_path": str(library),
                  "api_version": "1.4.0", "implementation_version": "1", "description": "Khronos validation",
                  "instance_extensions": [{"name": "VK_EXT_debug_utils", "spec_version": "1"},
                                          {"name": "VK_EXT_layer_settings", "spec_version": "2"}]}}))
    (layer / "settings.txt").write_text("".join(f"khronos_validation.{line}\n" for line in (
        "debug_action = VK_DBG_LAYER_ACTION_LOG_MSG", f"log_filename = {log}", "report_flags = error,warn,info",
        "validate_core = true", "validate_sync = true", "enable_message_limit = false")))
    shutil.rmtree(kit.work / "validated", ignore_errors=True)
    kit.program("fathom", "train", small_scene(kit), "-o", kit.work / "validated", "--allow-cpu", "--iterations",
                min(100, kit.settings["short_iterations"]), "--max-gaussians", 2000, "--seed", 1, seconds=180,
                environment={"VK_INSTANCE_LAYERS": "VK_LAYER_KHRONOS_validation", "VK_LAYER_PATH": str(layer),
                             "VK_LAYER_SETTINGS_PATH": str(layer / "settings.txt")})
    text = log.read_text(errors="replace") if log.exists() else ""
    kit.log(text[:200_000])
    # Silence of a layer that was not loaded would prove nothing.
    if "CURRENT-VALIDATION-ENABLED" not in text:
        raise Failed("the validation layer was not loaded")
    ids = re.findall(r"^Validation [A-Z][a-z ]+: \[ ([^] ]+) \]", text, re.MULTILINE)
    unknown = sorted(set(ids) - set(kit.settings["allowed_messages"]))
    kit.row("gpu_checks", "synth", "validation", "fathom train under the validation layer",
            {"known": len([i for i in ids if i not in unknown]), "unknown": len([i for i in ids if i in unknown])}, ", ".join(unknown))
    if unknown:
        raise Failed(f"the validation layer reports {', '.join(unknown)}")


# --- Times -------------------------------------------------------------------------------------------

def random_scene(kit, which):
    """The scene for gsplat, which takes the same numbers; written once."""
    return kit.work / f"random-{kit.settings['stages'][which][0]}.bin"


def stages(kit, which):
    """Device time of each kernel of a step over random Gaussians."""
    gaussians, width, height = kit.settings["stages"][which]
    begin = kit.now()
    # Hundreds of megabytes, which only gsplat needs.
    written = ["--write-scene", random_scene(kit, which)] if (HERE / "peers/gsplat").is_dir() else []
    out = kit.program("bench_random", gaussians, width, height, *written, "--repeats", kit.settings["repeats"], "--entries",
                      kit.settings["entries"], seconds=150)
    result = json.loads(out)
    (kit.work / f"stages-{which}.json").write_text(out)
    peak = next((rate for name, rate in PEAK_BANDWIDTH.items() if name in kit.adapter), None)
    at = begin
    for stage in result["stages"]:
        rate = stage.get("gigabytes_per_second")
        kit.row("gpu_stages", "random", f"{which} {stage['stage']}", f"bench_random {gaussians} {width} {height}",
                {"ms": 1e3 * stage["seconds"], "gb_per_s": rate, "share_of_peak": rate / peak if rate and peak else None})
        # One step, its kernels one behind the other.
        kit.trace(f"{which} {stage['stage']}", at, stage["seconds"], 3)
        at += stage["seconds"]
    kit.row("gpu_stages", "random", f"{which} step", f"bench_random {gaussians} {width} {height}",
            {"ms": 1e3 * sum(stage["seconds"] for stage in result["stages"]),
             "wall_ms": 1e3 * sum(times["wall_seconds"] for times in result["passes"].values()),
             "visible": result["visible"], "intersections": result["intersections"]})
    if result["digests"]:
        kit.log(f"digests: {result['digests']}")


def grouped(result, theirs):
    """Milliseconds by the groups of COMPARED: Fathom's and gsplat's."""
    times = {group: [0.0, 0.0] for group in COMPARED}
    for stage in result["stages"]:
        group = next((group for group, (names, _) in COMPARED.items() if stage["stage"] in names), "tiles")
        times[group][0] += 1e3 * stage["seconds"]
    median = {name: stage["median_ms"] for name, stage in theirs["stages"].items() if stage}
    for group, (_, names) in COMPARED.items():
        times[group][1] = sum(median[name] for name in names)
    times[ADAM[0]][1] += min(median[name] for name in ADAM[1] if name in median)
    return times


def gsplat_stages(kit, which):
    ready(kit, "gsplat")
    ours = kit.work / f"stages-{which}.json"
    if not ours.exists():
        stages(kit, which)
    theirs = json.loads(gsplat(kit, "stages", random_scene(kit, which), "--repeats", kit.settings["repeats"], seconds=150))
    times = grouped(json.loads(ours.read_text()), theirs)
    times["sum"] = [sum(pair[side] for pair in times.values()) for side in (0, 1)]
    for group, (mine, other) in times.items():
        kit.row("gpu_gsplat", "random", f"{which} {group}", "gsplat_bench.py stages",
                {"fathom_ms": mine, "gsplat_ms": other, "ratio": other / mine}, f"gsplat {theirs['version']}")


def trained(kit, figure, scene, variant, folder, settings, seconds):
    """Trains without the service, and gives a row; returns the result."""
    begin = kit.now()
    result = json.loads(kit.program("train_scene", folder, *settings, "--seed", 1, seconds=seconds))
    kit.row(figure, scene, variant, f"train_scene {scene} {' '.join(map(str, settings))}", {
        "psnr": result["psnr"], "ssim": result["ssim"], "gaussians": result["gaussians"], "iterations": result["iterations"],
        "wall_s": result["wall_seconds"], "ms_per_step": 1e3 * result["wall_seconds_per_step"],
        "device_ms_per_step": result["device_ms_per_step_at_the_end"], "peak_bytes": result["device_peak_bytes"],
        "forecast_bytes": result["forecast_bytes"], "card_peak_bytes": kit.sampler.peak_bytes(),
    }, json.dumps(result["share_of_stage"]))
    kit.trace(f"train {scene} {variant or ''}", begin, result["wall_seconds"], 2)
    return result


def scene_of(kit, name):
    """A real scene, or the small synthetic one in a rehearsal without them."""
    folder = HERE / "scenes" / name
    if folder.is_dir():
        return folder
    if kit.settings["rehearsal"]:
        return small_scene(kit)
    raise Failed(f"the kit was packed without {name}")


def fox(kit):
    """The whole schedule, then as many iterations as a minute holds."""
    settings = kit.settings["fox"]
    more = ["--max-gaussians", settings["max_gaussians"], "--max-resolution", settings["max_resolution"]]
    whole = trained(kit, "gpu_scene", "fox", None, scene_of(kit, "fox"), ["--iterations", settings["iterations"], *more], 250)
    seconds = settings["minute"]
    # Short runs take coarser steps, so this many end a little sooner.
    count = max(1, min(settings["iterations"], int(seconds / whole["wall_seconds_per_step"])))
    trained(kit, "gpu_scene", "fox", f"{seconds:g} s", scene_of(kit, "fox"), ["--iterations", count, *more], 120)


def wreck(kit):
    """The whole program under water: plan, partitions, water, merge, evaluation."""
    settings, folder, out = kit.settings["wreck"], scene_of(kit, "sesa-wreck"), kit.work / "wreck"
    shutil.rmtree(out, ignore_errors=True)
    words = ["--iterations", settings["iterations"], "--max-gaussians", settings["max_gaussians"], "--max-resolution",
             settings["max_resolution"], "--seed", 1]
    begin = kit.now()
    kit.program("fathom", "train", folder, "-o", out, "--allow-cpu", *words, seconds=250)
    wall = kit.now() - begin
    metrics = json.loads((out / "metrics.json").read_text())
    truth = {}
    if (folder / "truth").is_dir():
        truth = json.loads(kit.program("fathom", "eval", out, "--truth", folder / "truth", "--allow-cpu", "--json",
                                       seconds=60))["truth"]
    kit.row("gpu_scene", "sesa-wreck", None, f"fathom train sesa-wreck {' '.join(map(str, words))}",
            {"psnr": metrics["psnr"], "ssim": metrics["ssim"], "j_psnr": truth.get("psnr"), "gaussians": metrics["gaussians"],
             "wall_s": wall, "card_peak_bytes": kit.sampler.peak_bytes()}, json.dumps(metrics["seconds"]))


def large_scene(kit):
    """The synthetic scene in air, with photographs of a megapixel and as many points as Gaussians."""
    ready(kit, "scene")
    return kit.work / "large"


def mcmc(kit):
    """MCMC at its full number of Gaussians from the first step, all at full size and SH 3."""
    settings, folder = kit.settings["mcmc"], large_scene(kit)
    result = trained(kit, "gpu_mcmc", "synth", "fathom", folder, [
        "--iterations", settings["steps"], "--max-gaussians", settings["cap"], "--initial-points", settings["cap"],
        "--resolution-at", "[0,0]", "--sh-degree-at", "[0,0,0]", "--background-gaussians", "0"], 300)
    kit.row("gpu_mcmc", "synth", "fathom, 30k computed", f"{settings['steps']} steps, times 30000 / {settings['steps']}",
            {"wall_s": 30_000 * result["wall_seconds_per_step"]})


def peer_mcmc(kit, peer):
    """A peer on the same files, from as many points."""
    ready(kit, peer)
    settings, folder = kit.settings["mcmc"], large_scene(kit)
    words = [folder, "--steps", settings["steps"], "--cap", settings["cap"],
             # As in `mcmc`: SH 3 from the first step, and a schedule that ends with the run (VkSplat's does).
             "--sh-interval", 1]
    if peer == "gsplat":
        words += ["--points", settings["cap"], "--schedule-steps", settings["steps"]]
        result = json.loads(gsplat(kit, "train", *words, seconds=300))
    else:
        result = json.loads(vksplat(kit, *words, "--initial-points", settings["cap"], seconds=300))
    each = result["ms_per_step"] / 1e3 if peer == "gsplat" else result["wall_seconds_per_step"]
    psnr = result["psnr"] if peer == "gsplat" else result["held_out"][-1]["psnr"]
    kit.row("gpu_mcmc", "synth", peer, f"{peer} --steps {settings['steps']} --cap {settings['cap']}",
            {"psnr": psnr, "wall_s": each * settings["steps"], "ms_per_step": 1e3 * each,
             "gaussians": result["gaussians"], "peak_bytes": result.get("peak_bytes") or result.get("peak_device_bytes"),
             "card_peak_bytes": kit.sampler.peak_bytes()}, f"{peer} {result['commit'][:7]}, SSIM {result.get('ssim', 'its own')}")
    kit.row("gpu_mcmc", "synth", f"{peer}, 30k computed", f"{settings['steps']} steps, times 30000 / {settings['steps']}",
            {"wall_s": 30_000 * each})


# --- What is made in the background ------------------------------------------------------------------

def gsplat(kit, *arguments, seconds):
    return kit.run("bash", HERE / "peers/gsplat.sh", "run", HERE / "peers/gsplat", *arguments, seconds=seconds)


def vksplat(kit, *arguments, seconds):
    return kit.run(sys.executable, HERE / "peers/vksplat.py", *arguments, seconds=seconds,
                   environment={"PEERS_OUT": str(kit.work / "vksplat")})


def prepare(kit, needs):
    """Starts what takes minutes of CPU time and no GPU: the large scene, and the peers' builds."""
    large = kit.settings["mcmc"]
    commands = {
        "scene": [HERE / "bin/fathom", "synth", kit.work / "large", "--water", "off", "--views", large["views"], "--size",
                  large["size"], "--points-per-view", large["points_per_view"], "--seed", "1"],
        "vksplat": ["bash", HERE / "peers/vksplat.sh", "build", "--fallback" if kit.settings["rehearsal"] else "--native"],
        "gsplat": ["bash", HERE / "peers/gsplat.sh", "build", HERE / "peers/gsplat"],
    }
    packed = HERE / "peers/vksplat"
    for need in needs:
        if (kit.work / f"{need}.made").exists():
            continue
        if need != "scene" and not (HERE / "peers" / need).is_dir():
            kit.background[need] = f"the kit was packed without {need}"
            continue
        if need == "scene":
            shutil.rmtree(kit.work / "large", ignore_errors=True)
        log = open(kit.work / f"{need}.log", "w", encoding="utf-8")
        # A few CPUs stay free for the parts that run meanwhile.
        kit.background[need] = subprocess.Popen(
            ["nice", "-n", "19", *(str(word) for word in commands[need])], stdout=log, stderr=subprocess.STDOUT, start_new_session=True, cwd=kit.work,
            env={**kit.environment, "MAX_JOBS": str(max(1, (os.cpu_count() or 1) - 4)), "PEERS_OUT": str(kit.work / "vksplat"), "VKSPLAT_SOURCE": str(packed / "source"),
                 "VULKAN_HEADERS": str(packed / "include"), "GLM_HEADERS": str(packed / "include")})
        kit.say(f"{need}: being made in the background")


def ready(kit, need):
    """Waits for something of `prepare`."""
    process = kit.background.get(need)
    if process is None:
        return
    if isinstance(process, str):
        raise Failed(process)
    try:
        code = process.wait(timeout=max(1, min(300, kit.left() - 30)))
    except subprocess.TimeoutExpired:
        raise Failed(f"{need} is not made yet") from None
    if code != 0:
        text = (kit.work / f"{need}.log").read_text(errors="replace")
        kit.log(text[-20_000:])
        kit.background[need] = f"{need} could not be made ({code}): {(text.strip() or 'no output').splitlines()[-1]}"
        raise Failed(kit.background[need])
    (kit.work / f"{need}.made").touch()


def settle(kit):
    """Waits until nothing is made in the background, before a part whose wall time counts."""
    for need, process in kit.background.items():
        if not isinstance(process, str) and process.poll() is None:
            kit.say(f"waiting for {need}, which is being made")
            try:
                ready(kit, need)
            except Failed as error:
                kit.say(str(error))


# Name: kind, least seconds that must be left, what it needs from `prepare`, function. The least seconds are
# not what a part takes: they keep one from starting that has no chance. Stages are timed by the device, so
# they may run while something is made in the background.
WALL_TIMES = ("fox", "wreck", "mcmc", "vksplat-mcmc", "gsplat-mcmc")
PARTS = {
    "kernels": ("checks", 60, (), kernels),
    "device": ("checks", 20, (), device),
    "first": ("checks", 15, (), first),
    "bytes": ("checks", 30, (), bytes_again),
    "validation": ("checks", 40, (), validation),
    "stages-1m": ("times", 40, (), lambda kit: stages(kit, "1m")),
    "stages-3m": ("times", 50, (), lambda kit: stages(kit, "3m")),
    "mcmc": ("times", 90, ("scene",), mcmc),
    "fox": ("times", 60, (), fox),
    "wreck": ("times", 60, (), wreck),
    "gsplat-stages-1m": ("peers", 40, ("gsplat",), lambda kit: gsplat_stages(kit, "1m")),
    "gsplat-stages-3m": ("peers", 50, ("gsplat",), lambda kit: gsplat_stages(kit, "3m")),
    "vksplat-mcmc": ("peers", 90, ("scene", "vksplat"), lambda kit: peer_mcmc(kit, "vksplat")),
    "gsplat-mcmc": ("peers", 90, ("scene", "gsplat"), lambda kit: peer_mcmc(kit, "gsplat")),
}


def chosen(words):
    kinds = {kind for kind, *_ in PARTS.values()}
    if unknown := [word for word in words if word not in PARTS and word not in kinds]:
        sys.exit(f"run: there is no part {', '.join(unknown)}; parts are {', '.join(PARTS)}; kinds are {', '.join(sorted(kinds))}")
    return [name for name, (kind, *_) in PARTS.items() if not words or name in words or kind in words]


def tidy_up(kit):
    """Ends what still runs, and notes what was made."""
    kit.sampler.ended.set()
    for need, process in kit.background.items():
        if isinstance(process, str):
            continue
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        elif process.returncode == 0:
            (kit.work / f"{need}.made").touch()


def stop_on_signals():
    """SIGTERM ends it as Ctrl-C does, so that nothing goes on using the GPU."""
    def stop(*_):
        raise KeyboardInterrupt
    signal.signal(signal.SIGTERM, stop)


def run(words, out, limit, allow_cpu):
    out.mkdir(parents=True, exist_ok=True)
    stop_on_signals()
    kit = Kit(out.resolve(), limit, allow_cpu)
    kit.events = kit.read("trace.json", {}).get("traceEvents", [])
    kit.say(f"Fathom {kit.settings['version']} ({kit.settings['commit']}) on {platform.node()}, {os.cpu_count()} CPUs")
    try:
        find_gpu(kit)
    except Failed as error:
        kit.say(f"run: {error}")
        return 1
    wanted = [name for name in chosen(words) if kit.parts.get(name, {}).get("result") != "ok"]
    # What failed before is tried again, but last.
    wanted.sort(key=lambda name: name in kit.parts)
    left = []
    try:
        prepare(kit, dict.fromkeys(need for name in wanted for need in PARTS[name][2]))
        kit.sampler.start()
        for name in wanted:
            kind, least, _, function = PARTS[name]
            if kit.left() < least:
                left.append(name)
                continue
            begin, kit.sampler.peak = kit.now(), 0.0
            try:
                if name in WALL_TIMES:
                    settle(kit)
                function(kit)
                result = {"result": "ok"}
            except Failed as error:
                result = {"result": "failed", "why": str(error)}
            # A part goes wrong in its own ways; the others are worth their time all the same.
            except Exception as error:  # pylint: disable=broad-exception-caught
                result = {"result": "failed", "why": f"{type(error).__name__}: {error}"}
            kit.parts[name] = {"kind": kind, "seconds": round(kit.now() - begin, 1), **result}
            kit.say(f"{name}: {result['result']} in {kit.now() - begin:.1f} s {result.get('why', '')}")
            kit.trace(name, begin, kit.now() - begin, 1)
            (out / "parts.json").write_text(json.dumps(kit.parts, indent=1))
            kit.write_trace()
    except KeyboardInterrupt:
        kit.say("run: stopped; the parts that are done have their results")
        return 130
    finally:
        tidy_up(kit)
    if left:
        kit.say(f"no time was left for {', '.join(left)}; run this again")
    failed = [name for name in wanted if kit.parts.get(name, {}).get("result") == "failed"]
    kit.say(f"{len(wanted) - len(left) - len(failed)} parts are done"
            + (f", {len(failed)} failed: {', '.join(failed)}" if failed else "") + f"; results are in {out}")
    return 1 if failed else 0


def main():
    parser = argparse.ArgumentParser(prog="run", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help="parts or kinds of parts")
    parser.add_argument("--limit", type=float, default=570)
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--allow-cpu", action="store_true")
    said = parser.parse_args()
    if said.parts == ["list"]:
        for name, (kind, *_) in PARTS.items():
            print(f"{kind:7} {name}")
        return 0
    chosen(said.parts)
    return run(said.parts, said.out, said.limit, said.allow_cpu)


if __name__ == "__main__":
    sys.exit(main())
