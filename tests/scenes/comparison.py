"""Run folders of force recordings, made directly from the equations: every truth is known."""

import hashlib
import json
from dataclasses import asdict

import numpy as np
import pandas as pd

from vision.models import equations
from vision.sample import PUBLISHED


def events(
    *, mu=0.89, n_hat=0.57, modulus=3.8, amplitude=0.34, t0=0.0, sample=PUBLISHED, speed=1.0, step=0.03,
    d=(13.2, 17.5), scatter=0.015, jitter=0.07, k_noise=0.02, irregular_from=np.inf, irregular=0.3, seed=0,
):  # fmt: skip
    """Events from first to last separation, one every `step` mm, with scatter of peaks, drops and K."""
    rng = np.random.default_rng(seed)
    d_v = np.arange(*d, step)
    wild = np.where(d_v > irregular_from, irregular, jitter)
    drop = equations.stick_slip_amplitude(d_v, mu=mu, prefactor=amplitude, sample=sample)
    drop = drop * np.maximum(1 + wild * rng.standard_normal(d_v.size), 0.05)
    k = equations.assembly_stiffness(d_v, mu=mu, n_hat_N=n_hat, modulus_GPa=modulus, sample=sample)
    k = np.maximum(k, 20.0)
    d_p = d_v + drop / k
    peak = (equations.traction(d_p, mu=mu, sample=sample) + t0) * (
        1 + scatter * rng.standard_normal(d_v.size)
    )
    error = k_noise * k
    time = (d_v - d_v[0]) / speed * 60
    return pd.DataFrame(
        {
            "event": np.arange(d_v.size),
            "t_v_s": time,
            "t_p_s": time + 60 * (d_p - d_v) / speed,
            "d_v_mm": d_v,
            "d_p_mm": d_p,
            "F_v_N": peak - drop,
            "F_p_N": peak,
            "dF_N": drop,
            "stick_length_um": 1000 * (d_p - d_v),
            "slip_length_um": 0.2,
            "K_N_per_mm": k + error * rng.standard_normal(d_v.size),
            "K_err_N_per_mm": error,
            "flag": "ok",
        }
    )


def write_run(folder, table, *, speed=1.0, sample=PUBLISHED, models=None, **facts_of_force):
    """A folder as `track force` leaves it, as far as compare reads it."""
    folder.mkdir(parents=True)
    table.to_csv(folder / "events.csv", index=False)
    recording = {"source": f"{folder.name}.txt", "separation_from": "displacement", "d0_mm": 13.0}
    recording |= {"speed_mm_min": speed} | facts_of_force
    content = hashlib.sha256(table.to_csv().encode()).hexdigest()
    inputs = [{"path": recording["source"], "sha256": content}]
    facts = {"force": recording, "sample": asdict(sample), "inputs": inputs}
    (folder / "run.json").write_text(json.dumps(facts))
    (folder / "models.json").write_text(json.dumps({"sample": asdict(sample)} | (models or {})))
    return folder


def campaign(rng, *, mu_rh=0.004, mu_n=-0.0, n_hat_n=0.012, n_hat_rh=0.0, scatter_mu=0.004, scatter_n=0.015):
    """Truth of twelve tests of three samples: μ and N̂ follow humidity and age as told."""
    count = 12
    n_test, rh = (
        rng.permutation(np.linspace(9, 28, count).round()),
        rng.permutation(np.linspace(28, 55, count)),
    )
    mu = 0.87 + mu_rh * (rh - 41) + mu_n * (n_test - 18) + scatter_mu * rng.standard_normal(count)
    n_hat = 0.6 + n_hat_n * (n_test - 18) + n_hat_rh * (rh - 41) + scatter_n * rng.standard_normal(count)
    return pd.DataFrame(
        {
            "run": [f"test{k:02d}" for k in range(count)],
            "sample": np.repeat(["a", "b", "c"], 4),
            "V_mm_min": np.tile([0.5, 1.0, 0.5, 1.0], 3),
            "n_test": n_test,
            "RH_percent": rh,
            "mu": mu,
            "n_hat": n_hat,
            "t0": rng.uniform(-5, 5, count),
        }
    )


def write_campaign(folder, truth, *, seed=0, **options):
    """Run folders and tests.csv of `campaign`; Returns the folders and the table's path."""
    folders = []
    for k, row in truth.iterrows():
        made = events(
            mu=row["mu"], n_hat=row["n_hat"], t0=row["t0"], speed=row["V_mm_min"], seed=seed + k, **options
        )
        folders.append(write_run(folder / row["run"], made, speed=row["V_mm_min"]))
    table = folder / "tests.csv"
    truth[["run", "sample", "V_mm_min", "n_test", "RH_percent"]].to_csv(table, index=False)
    return folders, table
