// V at the centers of many states, for a target that gives its formula: REAL, DIM and FORMULA, an expression
// of the coordinates x[k] of a point and the parameters p[k], come on the command line of the compiler.

#include "_functions.hpp"

// Coordinate k of state n is x[k * room + n], V at center i of it goes to values[i * room + n]; offsets
// (count, DIM). Numbers are read and written up to the next multiple of the lanes.
extern "C" void staf_target(
    int64_t size, int64_t room, int64_t count, const void *states, const void *offsets, const void *parameters, void *values
) {
    constexpr int N = 4;
    typedef REAL T;
    typedef Block<T, N> B;
    const T *d = static_cast<const T *>(offsets), *p = static_cast<const T *>(parameters);
    (void)p;
    for (int64_t n = 0; n < size; n += B::lanes)
        for (int64_t i = 0; i < count; ++i) {
            B x[DIM];
            for (int k = 0; k < DIM; ++k)
                x[k] = load<T, N>(static_cast<const T *>(states) + k * room + n) + d[i * DIM + k];
            const B value = FORMULA;
            store(static_cast<T *>(values) + i * room + n, B::lanes, value);
        }
}
