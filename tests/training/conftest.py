from tests.operators.conftest import make_operator

__all__ = ["make_operator"]
