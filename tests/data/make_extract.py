"""Make the extracts in this folder anew: ``python tests/data/make_extract.py SOURCE``.

``SOURCE`` holds ``causal_chamber/lt_interventions_standard_v1``, the data set as it is
published, and ``hemodynamics``, the published numbers that the README names.
"""

import json
import shutil
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
DATASET = Path("causal_chamber", "lt_interventions_standard_v1")
NUM_ROWS = {"uniform_reference": 450, "uniform_l_11_mid": 30} | {
    f"uniform_{changed}_strong": 30
    for changed in (
        *("red", "green", "blue", "pol_1", "pol_2", "v_c"),
        *("t_ir_1", "t_vis_1", "t_ir_2", "t_vis_2", "t_ir_3", "t_vis_3"),
    )
}


def main(source: Path) -> None:
    for experiment, num_rows in NUM_ROWS.items():
        lines = (source / DATASET / f"{experiment}.csv").read_bytes().splitlines(True)
        target = HERE / DATASET / f"{experiment}.csv"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(b"".join(lines[: 1 + num_rows]))
    blood, target = source / "hemodynamics", HERE / "hemodynamics"
    (target / "openbf").mkdir(parents=True, exist_ok=True)
    waveform = "inflow_template_mynard2015.csv"
    shutil.copyfile(blood / waveform, target / waveform)
    facts = json.loads((blood / "pwdb_population_and_model_facts.json").read_text())
    chosen = {"_source": facts["_source"], "population": facts["population"]}
    text = json.dumps(chosen, indent=1) + "\n"
    (target / "pwdb_population.json").write_text(text)
    for case in ("cca", "ibif"):
        for name in (f"{case}.yaml", f"{case}_inlet.dat", "LICENSE"):
            shutil.copyfile(blood / "reference_openbf" / name, target / "openbf" / name)
        with np.load(blood / "reference_openbf" / f"ref_{case}.npz") as waves:
            pressures = {name: waves[name] for name in waves if name.endswith("__P")}
        np.savez(target / "openbf" / f"ref_{case}.npz", **pressures)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
