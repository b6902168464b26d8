#!/usr/bin/env bash
# The 95% interval of OpenTURNS' SubsetSampling holds a known probability in 80 of 100 runs.
#
# The failure is |u| > b or |v| > b of two independent standard normals, of probability 1 - (1 - 2 P(N > b))^2 = 1e-5, in
# four regions. The mean of the estimates is right; their spread over seeds is 1.3 times or more of the standard deviation
# that each of them reports (getStandardDeviation, and so getConfidenceLength). Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q openturns==1.27.post1 numpy
"$folder/venv/bin/python" - <<'PYTHON'
import math

import numpy
import openturns

P = 1e-5
RUNS = 100
openturns.Log.Show(openturns.Log.NONE)
b = openturns.Normal().computeQuantile(1 - (1 - math.sqrt(1 - P)) / 2)[0]
limit_state = openturns.SymbolicFunction(["u", "v"], [f"{b} - max(abs(u), abs(v))"])
vector = openturns.RandomVector(openturns.Normal(2))
composite = openturns.CompositeRandomVector(limit_state, vector)
event = openturns.ThresholdEvent(composite, openturns.Less(), 0.0)
rows = []
for seed in range(RUNS):
    openturns.RandomGenerator.SetSeed(seed)
    algorithm = openturns.SubsetSampling(event)
    algorithm.setMaximumOuterSampling(10_000)
    algorithm.run()
    result = algorithm.getResult()
    half = result.getConfidenceLength(0.95) / 2
    rows.append((result.getProbabilityEstimate(), result.getStandardDeviation(), half))
estimate, reported, half = numpy.array(rows).T
held = int((abs(estimate - P) < half).sum())
mean = estimate.mean() / P
spread = estimate.std(ddof=1) / reported.mean()
print(f"openturns {openturns.__version__}: mean {mean:.2f} p, spread {spread:.2f} of what is reported, interval holds p in {held} of {RUNS}")
assert 0.85 < mean < 1.15
assert spread > 1.3
assert held < 88
PYTHON
