from tests.operators.conftest import make_module, make_operator

__all__ = ["make_module", "make_operator"]
