from walk_env.walk import make_env

__all__ = ["make_env"]
