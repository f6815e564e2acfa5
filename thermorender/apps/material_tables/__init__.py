"""Tables of surface materials: imported, checked, compared, copied and plotted."""

RANK = 80
VERBS = {"materials": "verbs:app"}
