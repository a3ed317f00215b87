"""Samples a model of hBayesDM, as its Stan file says, with Stan.

Runs in a virtual environment of its own: hbayesdm_stan.py MODEL DATA.json WARMUP SAMPLES DRAWS.npz.
Without samples, it only compiles.

Stan no longer reads the declarations of arrays of 2021 and the function ``modulus``; these are
written as they are today, and the license at the beginning, a file of its own, is left out. Nothing
else is changed.
"""

import importlib.util
import json
import re
import sys
from pathlib import Path

import aiohttp
import numpy as np
import stan

N_CHAINS = 4
# PyStan waits for its own compiler as for a web page, and on a busy machine not long enough.
aiohttp.client.DEFAULT_TIMEOUT = aiohttp.ClientTimeout(total=None)
# real y[N, T];  ->  array[N, T] real y;
OLD_ARRAY = re.compile(r"(?m)^(\s*)((?:int|real)(?:<[^>]*>)?)\s+(\w+)\[([^\]]*)\];")
OLD_MODULUS = re.compile(r"modulus\((level2_choice\[i, ?t\]), 2\)")


def read_program(model: str) -> str:
    """Return the program of a model, in the language of today."""
    package = importlib.util.find_spec("hbayesdm").submodule_search_locations[0]
    path = Path(package) / "common" / "stan_files" / f"{model}.stan"
    text = path.read_text(encoding="utf-8").replace("#include /pre/license.stan", "")
    return OLD_MODULUS.sub(r"(\1 % 2)", OLD_ARRAY.sub(r"\1array[\4] \2 \3;", text))


def main() -> None:
    """Compile, sample, and write the draws; each as (chains, draws, ...)."""
    model, data, warmup, samples, out = sys.argv[1:]
    given = json.loads(Path(data).read_text(encoding="utf-8"))
    names = given.pop("names")
    posterior = stan.build(read_program(model), data=given, random_seed=1)
    if int(samples) == 0:
        return
    fitted = posterior.sample(num_chains=N_CHAINS, num_warmup=int(warmup), num_samples=int(samples))
    draws = {}
    for name in (*names, *(f"mu_{name}" for name in names), "sigma", "log_lik"):
        table = np.moveaxis(fitted[name], -1, 0)  # the chains take turns
        draws[name] = table.reshape(int(samples), N_CHAINS, *table.shape[1:]).swapaxes(0, 1)
    np.savez(out, **draws)


if __name__ == "__main__":
    main()
