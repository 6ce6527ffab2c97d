"""shim"""

from .appearance import AppearanceClassifier
from .filter import LogOddsFilter
from .smoother import ForwardBackwardSmoother


class _M:
    def __init__(self, c):
        self.c = c
        self.needs_features = c.use_head

    def filter(self, w, h):
        f = LogOddsFilter(self.c, w, h)
        f.appearance = f.head
        return f

    def smoother(self, w, h, a=None):
        s = ForwardBackwardSmoother(self.c, w, h, a or AppearanceClassifier(self.c))

        class X:
            def masks(self, pairs):
                from collections import deque

                q = deque()

                def g():
                    for d, t in pairs:
                        q.append(t)
                        yield d

                for m in s.masks(g()):
                    yield m, q.popleft()

        return X()


def build(c):
    return _M(c)
