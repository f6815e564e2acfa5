"""Networks that translate photographs into thermal pictures: published ones, and one of this project.

`recipes` lists them with their hyper-parameters; `predictor` applies a trained one.
"""
