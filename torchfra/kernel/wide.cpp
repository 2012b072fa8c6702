// Neighbouring tracks side by side in vector registers.  Functions are those of SLEEF, which torch has in its own library for
// the registers of AVX; elsewhere those of C++, lane by lane.
#if defined(__AVX512F__) && defined(__AVX512BW__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#include <immintrin.h>
#define BYTES 64
#define SLEEF_double(name, off) Sleef_##name##d8_u##off
#define SLEEF_float(name, off) Sleef_##name##f16_u##off
#define SQRT_double _mm512_sqrt_pd
#define SQRT_float _mm512_sqrt_ps
#define BITS_double(m) _mm512_movepi64_mask((__m512i)m)
#define BITS_float(m) _mm512_movepi32_mask((__m512i)m)
#define PAST_CACHES(to, v) _mm512_stream_si512(reinterpret_cast<__m512i*>(to), (__m512i)v)
#elif defined(__AVX2__) && defined(__FMA__)
#include <immintrin.h>
#define BYTES 32
#define SLEEF_double(name, off) Sleef_##name##d4_u##off
#define SLEEF_float(name, off) Sleef_##name##f8_u##off
#define SQRT_double _mm256_sqrt_pd
#define SQRT_float _mm256_sqrt_ps
#define BITS_double(m) _mm256_movemask_pd((__m256d)m)
#define BITS_float(m) _mm256_movemask_ps((__m256)m)
#define PAST_CACHES(to, v) _mm256_stream_si256(reinterpret_cast<__m256i*>(to), (__m256i)v)
#else
#define BYTES 16
#endif
constexpr int64_t W = BYTES / sizeof(SCALAR);
typedef SCALAR V __attribute__((vector_size(BYTES)));
typedef decltype(V() < V()) M;

// A function of one number or of two, called ``ours``: that of C++ in each lane; or one of SLEEF, off by so many tenths of the
// last place.
#define LANES1(ours, name)                           \
  static inline V ours(const V& a) {                 \
    V r;                                             \
    for (int i = 0; i < W; i++) r[i] = ::name(a[i]); \
    return r;                                        \
  }
#define LANES2(ours, name)                                 \
  static inline V ours(const V& a, const V& b) {           \
    V r;                                                   \
    for (int i = 0; i < W; i++) r[i] = ::name(a[i], b[i]); \
    return r;                                              \
  }
#ifdef SLEEF_double
#define FUNCTION1(ours, name, off)       \
  extern "C" V SLEEF_SCALAR(name, off)(V); \
  static inline V ours(const V& a) { return SLEEF_SCALAR(name, off)(a); }
#define FUNCTION2(ours, name, off)          \
  extern "C" V SLEEF_SCALAR(name, off)(V, V); \
  static inline V ours(const V& a, const V& b) { return SLEEF_SCALAR(name, off)(a, b); }
static inline V sqrt_(const V& a) { return SQRT_SCALAR(a); }
static inline int lanes(const M& m) { return BITS_SCALAR(m); }
#else
#define FUNCTION1(ours, name, off) LANES1(ours, name)
#define FUNCTION2(ours, name, off) LANES2(ours, name)
LANES1(sqrt_, sqrt)
static inline int lanes(const M& m) {
  int bits = 0;
  for (int i = 0; i < W; i++) bits |= (m[i] != 0) << i;
  return bits;
}
#endif
FUNCTION2(extreme_atan2, atan2, 10)

namespace {
inline V all(Scalar a) { return V{} + a; }
template <class T> NOINLINE V get(const Entries<T>& x, int64_t entry) {
  const T* from = x[entry];
  if (x.track == 0) return all(*from);
  V v;
  for (int64_t i = 0; i < W; i++) v[i] = from[(i < x.lanes ? i : x.lanes - 1) * x.track];
  return v;
}
inline V load(const Entries<Scalar>& x, int64_t entry) {
  if (x.lanes < W) return get(x, entry);
  V v;
  __builtin_memcpy(&v, x[entry], sizeof v);
  return v;
}
ALWAYS void write(const Entries<Scalar>& x, int64_t entry, const V& v) {
#ifdef PAST_CACHES  // a store that does not read the line first
  if (x.past && (reinterpret_cast<uintptr_t>(x.first) | x.entry * sizeof(Scalar)) % BYTES == 0) {
    PAST_CACHES(x[entry], v);
    return;
  }
#endif
  if (x.lanes < W) __builtin_memcpy(x[entry], &v, x.lanes * sizeof(Scalar));
  else __builtin_memcpy(x[entry], &v, sizeof v);
}
// The same where it is done once: a call.
NOINLINE void put(const Entries<Scalar>& x, int64_t entry, const V& v) { write(x, entry, v); }
inline void mark(const Entries<bool>& x, int64_t entry, const M& v) {
  bool* to = x[entry];
  for (int64_t i = 0; i < x.lanes; i++) to[i] = v[i] != 0;
}
inline V kept(const M& m) { return (V)m; }
inline M truth(const V& v) { return (M)v; }
inline bool any(const M& m) { return lanes(m); }

struct Lane { V* s; int number; };
// A region for the tracks where a truth value is ``value``: on the spot where they are most of a pack, else together with
// those of other packs.
template <int64_t PLACES> void guarded(
    V (*s)[PLACES], int64_t packs, int place, bool value, void (*region)(V*), const Values& taken, const Values& given) {
  V together[PLACES];
  Lane from[W];
  int count = 0;
  const auto flush = [&] {
    for (int j = count; j < W; j++)
      for (int i = 0; i < taken.count; i++) together[taken.places[i]][j] = together[taken.places[i]][0];
    region(together);
    for (int j = 0; j < count; j++)
      for (int i = 0; i < given.count; i++) from[j].s[given.places[i]][from[j].number] = together[given.places[i]][j];
    count = 0;
  };
  for (int64_t p = 0; p < packs; p++) {
    const M mask = truth(s[p][place]);
    int which = lanes(value ? mask : ~mask);
    if (which && (packs == 1 || 2 * __builtin_popcount(which) > W)) {
      region(s[p]);
      continue;
    }
    for (; which; which &= which - 1) {
      const int lane = __builtin_ctz(which);
      for (int i = 0; i < taken.count; i++) together[taken.places[i]][count] = s[p][taken.places[i]][lane];
      from[count++] = Lane{s[p], lane};
      if (count == W) flush();
    }
  }
  if (count) flush();
}

// The sign of one number and the size of another.
inline V signed_as(const V& size, const V& sign) {
  const M bit = (M{} - 1) << (8 * sizeof(Scalar) - 1);
  return (V)(((M)size & ~bit) | ((M)sign & bit));
}
inline V abs_(const V& a) { return signed_as(a, all(0)); }
// Of (atan(t) / t - 1) / t^2 by powers of t^2, the best of degree 10 for t within pi/8: off by 3e-17 at most.
constexpr Scalar C[] = {
    -0.3333333333333333, 0.19999999999995516, -0.14285714284665682, 0.11111111015187018, -0.09090904575306488, 0.07692183125376885,
    -0.06664510525508843, 0.058581409048656254, -0.050854078345862384, 0.039230447784709195, -0.01917540471101196};
// The arc tangent to 4e-16 of its size: a polynomial within pi/8, to which the first octant is brought by one division.
inline V atan2_(const V& y, const V& x) {
  constexpr Scalar TANGENT = 0.41421356237309503, QUARTER = 0.78539816339744828, TOP = sizeof(Scalar) == 8 ? 1e300 : 1e37;
  const V a = signed_as(x, all(0)), b = signed_as(y, all(0));
  const M steep = b > a;
  const V low = steep ? a : b, high = steep ? b : a;
  if (!EXPECT(!any(~((high > 1 / TOP) & (high < TOP))))) return extreme_atan2(y, x);
  const M beyond = low > TANGENT * high;
  const V t = (beyond ? low - high : low) / (beyond ? low + high : high), s = t * t, s2 = s * s, s4 = s2 * s2;
  const V p0 = (C[0] + C[1] * s) + (C[2] + C[3] * s) * s2, p1 = (C[4] + C[5] * s) + (C[6] + C[7] * s) * s2;
  const V p2 = (C[8] + C[9] * s) + C[10] * s2;
  const V octant = (t + t * s * (p0 + (p1 + p2 * s4) * s4)) + (beyond ? all(QUARTER) : all(0));
  const V quadrant = steep ? 2 * QUARTER - octant : octant;
  return signed_as((M)x < 0 ? 4 * QUARTER - quadrant : quadrant, y);
}
}  // namespace
