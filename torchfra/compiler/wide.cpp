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
#define OUTSIDE_double(a, least, most) (_mm512_cmp_pd_mask(a, least, _CMP_LT_OQ) | _mm512_cmp_pd_mask(a, most, _CMP_GT_OQ))
#define OUTSIDE_float(a, least, most) (_mm512_cmp_ps_mask(a, least, _CMP_LT_OQ) | _mm512_cmp_ps_mask(a, most, _CMP_GT_OQ))
#define SCALED_double(a, exponent) _mm512_scalef_pd(a, exponent)
#define SCALED_float(a, exponent) _mm512_scalef_ps(a, exponent)
#define EVERY_double(from, index) _mm512_i64gather_pd((__m512i)(index), from, 8)
#define MOVED_double(v, from) _mm512_permutexvar_pd((__m512i)(from), v)
#define MOVED_float(v, from) _mm512_permutexvar_ps((__m512i)(from), v)
#define PACKED_double(bits, numbers, rest) _mm512_mask_compress_epi64((__m512i)(rest), bits, (__m512i)(numbers))
#define PACKED_float(bits, numbers, rest) _mm512_mask_compress_epi32((__m512i)(rest), bits, (__m512i)(numbers))
#define SPREAD_double(bits, numbers) _mm512_maskz_expand_epi64(bits, (__m512i)(numbers))
#define SPREAD_float(bits, numbers) _mm512_maskz_expand_epi32(bits, (__m512i)(numbers))
// One of two stores: the compiler does not see the branch, behind which it would keep fewer values in registers.
#define ONE_OF(first) "cmpb $0, %2\n\tje 1f\n\tvmovntdq %1, %0\n\tjmp 2f\n1:\t" first " %1, %0%{%3%}\n2:"
#define STORE_double ONE_OF("vmovupd")
#define STORE_float ONE_OF("vmovups")
#define PAST_CACHES(to, v, past, count) \
  asm(STORE_SCALAR : "+m"(*reinterpret_cast<V*>(to)) : "v"(v), "qm"(past), "Yk"((unsigned short)((1u << (count)) - 1)) : "cc")
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
  static INLINE V ours(const V& a) {                 \
    V r;                                             \
    for (int i = 0; i < W; i++) r[i] = ::name(a[i]); \
    return r;                                        \
  }
#define LANES2(ours, name)                                 \
  static INLINE V ours(const V& a, const V& b) {           \
    V r;                                                   \
    for (int i = 0; i < W; i++) r[i] = ::name(a[i], b[i]); \
    return r;                                              \
  }
#ifdef SLEEF_double
#define FUNCTION1(ours, name, off)       \
  extern "C" V SLEEF_SCALAR(name, off)(V); \
  static INLINE V ours(const V& a) { return SLEEF_SCALAR(name, off)(a); }
#define FUNCTION2(ours, name, off)          \
  extern "C" V SLEEF_SCALAR(name, off)(V, V); \
  static INLINE V ours(const V& a, const V& b) { return SLEEF_SCALAR(name, off)(a, b); }
static INLINE V sqrt_(const V& a) { return SQRT_SCALAR(a); }
static INLINE int lanes(const M& m) { return BITS_SCALAR(m); }
#else
#define FUNCTION1(ours, name, off) LANES1(ours, name)
#define FUNCTION2(ours, name, off) LANES2(ours, name)
LANES1(sqrt_, sqrt)
static INLINE int lanes(const M& m) {
  int bits = 0;
  for (int i = 0; i < W; i++) bits |= (m[i] != 0) << i;
  return bits;
}
#endif
namespace {
INLINE V all(Scalar a) { return V{} + a; }
// The number of each lane.
INLINE M numbers() {
  M m;
  for (int i = 0; i < W; i++) m[i] = i;
  return m;
}
template <class T> NOINLINE V get(const Entries<T>& x, int64_t entry) {
  const T* from = x[entry];
  if (x.track == 0) return all(*from);
#ifdef EVERY_double
  if constexpr (DOUBLE && sizeof(T) == sizeof(Scalar)) {
    const M lane = numbers(), last = M{} + (x.lanes - 1);
    return (V)EVERY_double(from, (lane < last ? lane : last) * x.track);
  }
#endif
  V v;
  for (int64_t i = 0; i < W; i++) v[i] = from[(i < x.lanes ? i : x.lanes - 1) * x.track];
  return v;
}
INLINE V load(const Entries<Scalar>& x, int64_t entry) {
  if (x.lanes < W) return get(x, entry);
  V v;
  __builtin_memcpy(&v, x[entry], sizeof v);
  return v;
}
// Without a call, also of the last tracks, which may be few: values of a step stay in registers.  A store past
// the caches does not read the line first.
INLINE void write(const Entries<Scalar>& x, int64_t entry, const V& v) {
#ifdef STORE_double
  PAST_CACHES(x[entry], v, x.past, x.lanes);
#else
#ifdef PAST_CACHES
  if (x.past) {
    PAST_CACHES(x[entry], v);
    return;
  }
#endif
  if (EXPECT(x.lanes >= W)) __builtin_memcpy(x[entry], &v, sizeof v);
  else
    for (int64_t i = 0; i < x.lanes; i++) x[entry][i] = v[i];
#endif
}
// The same where it is done once: a call.
NOINLINE void put(const Entries<Scalar>& x, int64_t entry, const V& v) { write(x, entry, v); }
INLINE void mark(const Entries<bool>& x, int64_t entry, const M& v) {
  bool* to = x[entry];
  for (int64_t i = 0; i < x.lanes; i++) to[i] = v[i] != 0;
}
INLINE V kept(const M& m) { return (V)m; }
INLINE M truth(const V& v) { return (M)v; }
// Whether no lane is outside; NaN is not.
INLINE bool within(const V& a, Scalar least, Scalar most) {
#ifdef OUTSIDE_double
  return !OUTSIDE_SCALAR(a, all(least), all(most));
#else
  return !lanes((a < least) | (a > most));
#endif
}

// In each lane what is in that lane whose number is in ``from``.
INLINE V moved(const V& v, const M& from) {
#ifdef MOVED_double
  return MOVED_SCALAR(v, from);
#else
  V r;
  for (int i = 0; i < W; i++) r[i] = v[from[i] & (W - 1)];
  return r;
#endif
}
// The numbers of the lanes in ``which``, side by side; then that of the first one.
INLINE M packed(int which) {
  M r = M{} + __builtin_ctz(which);
#ifdef PACKED_double
  r = (M)PACKED_SCALAR(which, numbers(), r);
#else
  for (int i = 0; which; which &= which - 1) r[i++] = __builtin_ctz(which);
#endif
  return r;
}
// In each lane in ``which`` how many of them come before it.
INLINE M ranks(int which) {
#ifdef SPREAD_double
  return (M)SPREAD_SCALAR(which, numbers());
#else
  M r{};
  for (int i = 0; which; which &= which - 1) r[__builtin_ctz(which)] = i++;
  return r;
#endif
}
struct Lanes { V* s; M which, places; };
// A region for the tracks where a truth value is ``value``, together with those of other packs.  ``first(p)`` computes what all
// tracks of pack p need; what the region takes of it is gathered while that is in the first cache.
template <int64_t PLACES, int64_t ASIDE, class First> void guarded(
    V (*s)[PLACES], V (&aside)[ASIDE], int64_t packs, int place, bool value, void (*region)(V*), const Values& taken,
    const Values& passed, const Values& given, const First& first) {
  V together[PLACES + ASIDE];
  Lanes from[W];
  int count = 0, sources = 0;
  const auto flush = [&] {
    region(together);
    for (const Lanes* x = from; x < from + sources; x++)
      for (int i = 0; i < given.count; i++) {
        V& to = x->s[given.places[i]];
        to = x->which ? moved(together[given.places[i]], x->places) : to;
      }
    count = sources = 0;
  };
  for (int64_t p = 0; p < packs; p++) {
    first(p);
    M waiting = value ? truth(s[p][place]) : ~truth(s[p][place]);
    while (const int which = lanes(waiting)) {
      const M rank = ranks(which), now = waiting & (rank < int{W} - count), free = numbers() >= count;
      const M places = (M)moved((V)packed(which), numbers() - count);
      const auto gather = [&](const Values& wanted, const V* values, V* to) {
        for (int i = 0; i < wanted.count; i++) {
          const int k = wanted.places[i];
          to[k] = free ? moved(values[k], places) : to[k];
        }
      };
      gather(taken, s[p], together);
      gather(passed, aside, together + PLACES);
      from[sources++] = Lanes{s[p], now, rank + count};
      count += __builtin_popcount(lanes(now));
      waiting &= ~now;
      if (count == W) flush();
    }
  }
  if (count) flush();
}

// The sign of one number and the size of another.
INLINE V signed_as(const V& size, const V& sign) {
  const M bit = (M{} - 1) << (8 * sizeof(Scalar) - 1);
  return (V)(((M)size & ~bit) | ((M)sign & bit));
}
INLINE V abs_(const V& a) { return signed_as(a, all(0)); }
// Of (atan(t) / t - 1) / t^2 by powers of t^2, the best of degree 10 for t within pi/8: off by 3e-17 at most.
constexpr Scalar C[] = {
    -0.3333333333333333, 0.19999999999995516, -0.14285714284665682, 0.11111111015187018, -0.09090904575306488, 0.07692183125376885,
    -0.06664510525508843, 0.058581409048656254, -0.050854078345862384, 0.039230447784709195, -0.01917540471101196};
// The arc tangent to 4e-16 of its size: a polynomial within pi/8, to which the first octant is brought by one division.
INLINE V atan2_(const V& y, const V& x) {
  constexpr Scalar TANGENT = 0.41421356237309503, QUARTER = 0.78539816339744828, TOP = DOUBLE ? 1e300 : 1e37, INF = INFINITY;
  const V a = signed_as(x, all(0)), b = signed_as(y, all(0));
  const M steep = b > a;
  V low = steep ? a : b, high = steep ? b : a;
  if (!EXPECT(within(high, 1 / TOP, TOP))) {  // only their ratio counts
    const V factor = high > TOP ? all(1 / TOP) : high < 1 / TOP ? all(TOP) : all(1);
    low = high == INF ? (low == INF ? all(1) : low * 0) : low * factor;
    high = high == INF ? all(1) : high == 0 ? all(1) : high * factor;
  }
  const M beyond = low > TANGENT * high;
  const V t = (beyond ? low - high : low) / (beyond ? low + high : high), s = t * t, s2 = s * s, s4 = s2 * s2;
  const V p0 = (C[0] + C[1] * s) + (C[2] + C[3] * s) * s2, p1 = (C[4] + C[5] * s) + (C[6] + C[7] * s) * s2;
  const V p2 = (C[8] + C[9] * s) + C[10] * s2;
  const V octant = (t + t * s * (p0 + (p1 + p2 * s4) * s4)) + (beyond ? all(QUARTER) : all(0));
  const V quadrant = steep ? 2 * QUARTER - octant : octant;
  return signed_as((M)x < 0 ? 4 * QUARTER - quadrant : quadrant, y);
}
// Exponentials and logarithms are many, and a call would send all values of a step to memory: they are written here.
constexpr int DIGITS = DOUBLE ? 52 : 23;  // of a number in binary, behind the first
constexpr Scalar LN2_HIGH = DOUBLE ? 0x1.62e42feep-1 : 0x1.62e4p-1;  // whole multiples of it are exact
constexpr Scalar LN2_LOW = DOUBLE ? 0x1.a39ef35793c76p-33 : 0x1.7f7d1cf79abcap-20;
constexpr Scalar WHOLE = DOUBLE ? 0x1.8p52 : 0x1.8p23;  // a number that is added to it is rounded, and in the last bits of the sum
INLINE V power_of_two(const M& exponent) { return (V)((exponent << DIGITS) + (M)all(1)); }
// To a rounding: a power of two times a Taylor polynomial within ln(2) / 2, off by 5e-18 at most.
INLINE V exp_(const V& x) {
  constexpr Scalar SMALLEST = DOUBLE ? -746 : -104, LARGEST = DOUBLE ? 710 : 89;  // beyond, the result is 0 or infinite
  constexpr Scalar T[] = {1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880, 1. / 3628800,
      1. / 39916800, 1. / 479001600, 1. / 6227020800};
  const V low = SMALLEST > x ? all(SMALLEST) : x, a = LARGEST < low ? all(LARGEST) : low;
  const V shifted = a * Scalar(1.4426950408889634) + WHOLE, k = shifted - WHOLE;
  const V r = (a - k * LN2_HIGH) - k * LN2_LOW, r2 = r * r, r4 = r2 * r2;
  const V p0 = (T[0] + T[1] * r) + (T[2] + T[3] * r) * r2, p1 = (T[4] + T[5] * r) + (T[6] + T[7] * r) * r2;
  const V p2 = (T[8] + T[9] * r) + (T[10] + T[11] * r) * r2;
  const V p = 1 + (r + r2 * (p0 + (p1 + p2 * r4) * r4));
#ifdef SCALED_double
  return SCALED_SCALAR(p, k);
#else
  const M whole = (M)shifted - (M)all(WHOLE), half = whole >> 1;  // in halves: the power alone may be out of range
  return p * power_of_two(half) * power_of_two(whole - half);
#endif
}
// To a rounding, as in FDLIBM (Sun Microsystems, 1993): exponent and fraction, and of that a rational function.
INLINE V log_(const V& x) {
  constexpr int MORE = DOUBLE ? 54 : 25;
  constexpr Scalar LOWEST = DOUBLE ? 0x1p-1022 : 0x1p-126, UP = DOUBLE ? 0x1p54 : 0x1p25, ROOT = 0.70710678118654752;
  constexpr Scalar L[] = {0.6666666666666735130, 0.3999999999940941908, 0.2857142874366239149, 0.2222219843214978396,
      0.1818357216161805012, 0.1531383769920937332, 0.1479819860511658591};
  const M tiny = x < LOWEST, bits = (M)(tiny ? x * UP : x), exponent = (bits - (M)all(ROOT)) >> DIGITS;
  const V k = (V)(exponent + (M)all(WHOLE)) - (tiny ? all(WHOLE + MORE) : all(WHOLE));
  const V f = (V)(bits - (exponent << DIGITS)) - 1, s = f / (2 + f), z = s * s, w = z * z, half = Scalar(0.5) * f * f;
  const V p = z * ((L[0] + L[1] * z) + ((L[2] + L[3] * z) + ((L[4] + L[5] * z) + L[6] * w) * w) * w);
  const V found = k * LN2_HIGH + (f - (half - (s * (half + p) + k * LN2_LOW)));
  const V extreme = x < 0 ? all(NAN) : x == 0 ? all(-INFINITY) : x;
  return (x > 0) & (x < INFINITY) ? found : extreme;
}
}  // namespace
