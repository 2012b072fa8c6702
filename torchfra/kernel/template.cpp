#include <cmath>
#include <cstdint>
#include <limits>

#ifdef _MSC_VER
#define NOINLINE __declspec(noinline)
#else
#define NOINLINE __attribute__((noinline))
#endif

namespace {
using Scalar = SCALAR;

// A tensor: where it is, and how far it is to the next track, the next step, the next entry.
struct Port { char* data; int64_t track, time, entry; };
// A block of tracks at a step; those beyond the last are the last once more.
struct Block { int64_t first, lanes, step; };

// The entries of a tensor at a step, from the first track of a block on.
template <class T> struct Entries {
  T* first;
  int64_t track, entry, lanes;
  Entries(const Port& p, const Block& at)
      : first(reinterpret_cast<T*>(p.data) + at.first * p.track + at.step * p.time), track(p.track), entry(p.entry), lanes(at.lanes) {}
  T* operator[](int64_t number) const { return first + number * entry; }
};
// Places of values: those that a region of a step takes from the rest of it, or those that it gives.
struct Values { const short* places; int count; };
}  // namespace

// LANES
namespace {
inline V max_(const V& a, const V& b) { return (a > b) | (a != a) ? a : b; }
inline V min_(const V& a, const V& b) { return (a < b) | (a != a) ? a : b; }

// Sums of squares from LEAST to MOST have lost nothing to under- or overflow; outside, factors UP and DOWN bring them there.
constexpr bool wide = sizeof(Scalar) == 8;
constexpr Scalar LEAST = wide ? 0x1p-960 : 0x1p-100, MOST = wide ? 0x1p1000 : 0x1p120;
constexpr Scalar UP = wide ? 0x1p600 : 0x1p90, DOWN = wide ? 0x1p-600 : 0x1p-90;
NOINLINE V scaled_norm(const V* a, int count, const V& squares) {
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
namespace NAME {
constexpr int PLACES = SIZE;  // of values that go from piece to piece, side by side for each pack of tracks
constexpr int64_t PACKS = MANY;  // at most, in a block of tracks
// PIECES
void block(const Port* in, const Port* out, int64_t steps, const Block& tracks) {
  V s[PACKS][PLACES];
  Block at[PACKS];
  const int64_t packs = (tracks.lanes + W - 1) / W;
  for (int64_t p = 0; p < packs; p++) {
    const int64_t left = tracks.lanes - p * W;
    at[p] = Block{tracks.first + p * W, left < W ? left : W, 0};
    // FIXED
  }
  for (int64_t k = 0; k < steps; k++) {
    for (int64_t p = 0; p < packs; p++) at[p].step = TIME;
    // STEP
  }
  for (int64_t p = 0; p < packs; p++) {
    at[p].step = 0;
    // END
  }
}
}  // namespace NAME
}  // namespace
