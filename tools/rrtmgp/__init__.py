"""Gas absorption from the k-distribution of RRTMGP, in full resolution: a second opinion on the shipped air."""
