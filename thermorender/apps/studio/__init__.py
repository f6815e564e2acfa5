"""The material studio: a page in the browser where an edit of a material table shows in the rendered frame."""

RANK = 40
VERBS = {"studio": "verbs:studio"}
