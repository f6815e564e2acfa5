"""Files for other programs, from the frames of a folder: labels, masks, geotagged images."""

RANK = 90
VERBS = {"export": "verbs:app"}
