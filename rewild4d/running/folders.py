"""Name the places below the folder of all runs."""

from pathlib import Path


def run_folder(out: Path, protocol: str, case: str, method: str, preset: str, seed: int, run_id: str) -> Path:
    """Return the folder of a run below the folder of all runs."""
    return out / protocol / case.replace("/", "__") / f"{method}-{preset}-seed{seed}-{run_id[:8]}"


def prior_file(out: Path, identity: str) -> Path:
    """Return where the prior of a case is kept below the folder of all runs."""
    return out / "priors" / f"{identity}.npz"
