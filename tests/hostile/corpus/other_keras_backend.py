for name in ("jax", "torch"):
    must_end_in_one_line(
        python("import sys; sys.argv = ['sionna-partial', 'info']; from sionna_partial.cli import main; main()", KERAS_BACKEND=name), 0, 2
    )
    result = python("import sionna_partial as sp\ntry:\n    sp.Predictor.load()\nexcept sp.SionnaPartialError as error:\n    print(error)", KERAS_BACKEND=name)
    must_end_in_one_line(result, 0)
