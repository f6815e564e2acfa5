"""Networks that translate photographs into thermal pictures, listed by `recipes` and applied by `predictor`."""
