"""Training of learned maps: pictures and renderings become data sets, data sets become maps."""

RANK = 60
VERBS = {"prepare": "verbs:prepare", "dataset": "verbs:dataset", "train": "verbs:train", "translate": "verbs:translate"}
