"""Tables of surface materials: imported, checked, compared, copied and plotted."""

VERBS = {"materials": "verbs:app"}
