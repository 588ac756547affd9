result = python("""
import multiprocessing, sionna_partial as sp, sys
sys.path.insert(0, %r)
from inputs import room, TX
def predict(_):
    try:
        return len(sp.predict_map(room(), TX, spacing_m=1.0, predictor="paper"))
    except sp.SionnaPartialError as error:
        return str(error)
predict(0)
with multiprocessing.get_context("fork").Pool(1) as pool:
    answer = pool.map_async(predict, [0]).get(60)[0]
assert isinstance(answer, str) and "spawn" in answer, answer
""" % HERE)
must_end_in_one_line(result, 0)
