"""Shape annotations such as `Float[Tensor, "N 3"]`; tests check them if jaxtyping is installed."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Shaped, UInt8
else:
    try:
        from jaxtyping import Bool, Float, Int, Shaped, UInt8
    except ImportError:

        class _Shaped:
            """Substitute for jaxtyping: `Float[Tensor, "N 3"]` is `Tensor`."""

            def __class_getitem__(cls, item: tuple[Any, str]) -> Any:
                return item[0]

        Bool = Float = Int = Shaped = UInt8 = _Shaped

__all__ = ["Bool", "Float", "Int", "Shaped", "UInt8"]
