"""Child process of test_sensor_registry: the bench with one more folder of sensors, from scenario to report.

Arguments: the folder with the new sensor's module, a scratch folder. Prints what came of it as JSON.
"""

import json
import sys
from pathlib import Path

import testbed.sensors

testbed.sensors.__path__.append(sys.argv[1])

import numpy as np  # noqa: E402

from testbed import pipeline  # noqa: E402
from testbed.data.records import SensorLog  # noqa: E402
from testbed.formats import export_log, import_log  # noqa: E402
from testbed.montecarlo import runner  # noqa: E402
from testbed.report import render  # noqa: E402
from testbed.scenario import load_scenario  # noqa: E402
from testbed.sensors import list_sensors  # noqa: E402

scratch = Path(sys.argv[2])
scenario = load_scenario(scratch / "scenario.toml")
log, _ = pipeline.sense(scenario, pipeline.fly(scenario))
log.save(scratch / "log")
export_log(log, scratch / "csv", "csv")
loaded, imported = SensorLog.load(scratch / "log"), import_log("table", scratch / "csv").log
runner.run(scenario, scratch / "result", jobs=1)
render(scratch / "result", svg=False)
told = {
    "catalogue": list_sensors()["rangefinder"],
    "range": log.rangefinder.range[:3].tolist(),
    "count": len(log.rangefinder.t),
    "loaded": bool(np.array_equal(loaded.rangefinder.range, log.rangefinder.range)),
    "imported": bool(np.array_equal(imported.rangefinder.range, log.rangefinder.range)),
    "sigma": [loaded.rangefinder.spec.noise_sigma, imported.rangefinder.spec.noise_sigma],
    "report": (scratch / "result" / "report.md").read_text(),
}
print(json.dumps(told))
