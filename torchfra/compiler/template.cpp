#ifdef __CUDACC_RTC__  // it has no headers
using int64_t = long long;
#define NAN __int_as_float(0x7fc00000)
#define INFINITY __int_as_float(0x7f800000)
#else
#include <math.h>
#include <cstdint>
#endif

// Functions that are called once for each step (on a GPU only of long steps), and those that are written where they are used.
#ifdef __CUDACC__
#ifdef LONG
#define NOINLINE static __device__ __noinline__
#else
#define NOINLINE static __device__ __forceinline__
#endif
#define INLINE __device__ __forceinline__
#else
#ifdef _MSC_VER
#define NOINLINE static __declspec(noinline)
#define INLINE __forceinline
#else
#define NOINLINE static __attribute__((noinline))
#define INLINE inline __attribute__((always_inline))
#endif
#endif

namespace {
using Scalar = SCALAR;
constexpr bool DOUBLE = sizeof(Scalar) == 8;

// A tensor: where it is, and how far it is to the next track, the next step, the next entry.
struct Port { char* data; int64_t track, time, entry; };
// A track at a step.
struct Block { int64_t first, step; };

// The entries of a tensor at a step, of one track.
template <class T> struct Entries {
  T* first;
  int64_t entry;
  INLINE Entries(const Port& p, const Block& at)
      : first(reinterpret_cast<T*>(p.data) + at.first * p.track + at.step * p.time), entry(p.entry) {}
  INLINE T& operator[](int64_t number) const { return first[number * entry]; }
};

INLINE Scalar largest(Scalar a, Scalar b) { return (a > b) | (a != a) ? a : b; }
INLINE Scalar smallest(Scalar a, Scalar b) { return (a < b) | (a != a) ? a : b; }

// Sums of squares from LEAST to MOST have lost nothing to under- or overflow; outside, factors UP and DOWN bring them there.
constexpr Scalar LEAST = DOUBLE ? 0x1p-960 : 0x1p-100, MOST = DOUBLE ? 0x1p1000 : 0x1p120;
constexpr Scalar LOWEST = DOUBLE ? 0x1p-1022 : 0x1p-126;  // that is normal
constexpr Scalar UP = DOUBLE ? 0x1p600 : 0x1p90, DOWN = DOUBLE ? 0x1p-600 : 0x1p-90;
// Four at a time: none waits for all that come before it.
template <class... A> INLINE Scalar sum_of_squares(Scalar a, A... more) {
  return ((a * a) + ... + (more * more));
}
template <class... A> INLINE Scalar sum_of_squares(Scalar a, Scalar b, Scalar c, Scalar d, A... more) {
  const Scalar four = (a * a + b * b) + (c * c + d * d);
  if constexpr (sizeof...(more) == 0) return four;
  else return four + sum_of_squares(more...);
}
// The Euclidean norm, scaled where that is needed: hardly ever.  Others keep what they have without scaling, to the bit.  No
// function is called, so that the values of a step stay in registers.
template <class... A> INLINE Scalar norm(A... a) {
  const Scalar squares = sum_of_squares(a...);
  const bool small = squares < LEAST, large = squares > MOST;
  if (!(small | large)) return ::sqrt(squares);
  const Scalar factor = small ? UP : DOWN;
  const Scalar scaled = ::sqrt(sum_of_squares(a * factor...)) / factor;
  return scaled < LOWEST ? Scalar(0) : scaled;  // its inverse would not be finite
}
}  // namespace

namespace {
namespace NAME {
constexpr int PLACES = SIZE;  // of values that go from piece to piece
constexpr int LEFT = UNREAD;  // of values that are carried but that no step reads
// PIECES
static INLINE void block(const Port* in, const Port* out, int64_t steps, int64_t track) {
  Scalar s[PLACES], left[LEFT];
  Block at{track, 0};
  // FIXED
  for (int64_t k = 0; k < steps; k++) {
    at.step = TIME;
    // STEP
  }
  at.step = 0;
  end(s, left, out, at);
}
}  // namespace NAME
}  // namespace
