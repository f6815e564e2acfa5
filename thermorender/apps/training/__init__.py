"""Training of learned maps: pictures and renderings become data sets, data sets become maps."""

VERBS = {"prepare": "verbs:prepare", "dataset": "verbs:dataset", "train": "verbs:train", "translate": "verbs:translate"}
