"""The paper's experiments on simulated stand-ins for an arm, and its claims: `python -m benchmarks paper`.

`trials` lists what is compared, `experiments` has the stages' functions, `trial` runs one trial,
`independence` the claims that need no arm, `report` makes figures and checks targets, `pictures` draws them.
"""
