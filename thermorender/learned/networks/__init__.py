"""Networks that translate photographs into thermal pictures: those of the literature, and one of this project.

`recipes` lists them with their hyper-parameters, `loop` trains any of them, `predictor` applies what was trained.
"""
