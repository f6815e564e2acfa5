"""Real frames: cameras fitted to their footage, and maps of temperature reconstructed from surveys."""

RANK = 70
VERBS = {"fit-camera": "verbs:fit_camera", "reconstruct": "verbs:reconstruct"}
