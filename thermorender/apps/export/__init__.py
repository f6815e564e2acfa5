"""Files for other programs, from the frames of a folder: labels, masks, geotagged images."""

VERBS = {"export": "verbs:app"}
