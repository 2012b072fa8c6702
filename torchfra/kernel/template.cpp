#include <cmath>
#include <cstdint>
#include <limits>

namespace {
using Scalar = SCALAR;

// A tensor: where it is, and how far it is to the next track, the next step, the next entry.
struct Port { char* data; int64_t track, time, entry; };
// A block of tracks at a step; those beyond the last are the last once more.
struct Block { int64_t first, lanes, step; };

template <class T> inline T* at_(const Port& p, int64_t entry, const Block& at) {
  return reinterpret_cast<T*>(p.data) + at.first * p.track + at.step * p.time + entry * p.entry;
}
}  // namespace

// LANES
namespace {
inline V max_(const V& a, const V& b) { return (a > b) | (a != a) ? a : b; }
inline V min_(const V& a, const V& b) { return (a < b) | (a != a) ? a : b; }

// Sums of squares from LEAST to MOST have lost nothing to under- or overflow; outside, factors UP and DOWN bring them there.
constexpr bool wide = sizeof(Scalar) == 8;
constexpr Scalar LEAST = wide ? 0x1p-960 : 0x1p-100, MOST = wide ? 0x1p1000 : 0x1p120;
constexpr Scalar UP = wide ? 0x1p600 : 0x1p90, DOWN = wide ? 0x1p-600 : 0x1p-90;
__attribute__((noinline, cold)) V scaled_norm(const V* a, int count, const V& squares) {
  const V factor = squares < LEAST ? all(UP) : squares > MOST ? all(DOWN) : all(1);
  V sum = all(0);
  for (int i = 0; i < count; i++) sum += (a[i] * factor) * (a[i] * factor);
  const V norm = sqrt_(sum) / factor;
  return norm < std::numeric_limits<Scalar>::min() ? all(0) : norm;  // its inverse would not be finite
}
// The Euclidean norm, scaled where that is needed: hardly ever.
template <class... A> inline V norm_(const A&... a) {
  const V squares = (... + (a * a));
  const M outside = (squares < LEAST) | (squares > MOST);
  if (!any(outside)) return sqrt_(squares);
  const V all_of_them[] = {a...};
  return scaled_norm(all_of_them, sizeof...(a), squares);
}
}  // namespace

namespace {
void block(const Port* in, const Port* out, int64_t steps, Block at) {
    // FIXED
  for (int64_t k = 0; k < steps; k++) {
    at.step = TIME;
    // STEP
  }
  at.step = 0;
    // END
}
}  // namespace
