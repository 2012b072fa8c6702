// Neighbouring tracks side by side in vector registers, by torch's vectors and their mathematics.
#if defined(__AVX512F__) && defined(__AVX512BW__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define CPU_CAPABILITY_AVX512
#elif defined(__AVX2__) && defined(__FMA__)
#define CPU_CAPABILITY_AVX2
#endif
#include <ATen/cpu/vec/vec.h>

namespace {
using Vec = at::vec::Vectorized<Scalar>;
constexpr int64_t W = Vec::size();
typedef Scalar V __attribute__((vector_size(W * sizeof(Scalar))));
typedef decltype(V() < V()) M;

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
inline void put(const Entries<Scalar>& x, int64_t entry, const V& v) {
  if (x.lanes < W) __builtin_memcpy(x[entry], &v, x.lanes * sizeof(Scalar));
  else __builtin_memcpy(x[entry], &v, sizeof v);
}
inline void mark(const Entries<bool>& x, int64_t entry, const M& v) {
  bool* to = x[entry];
  for (int64_t i = 0; i < x.lanes; i++) to[i] = v[i] != 0;
}
inline V kept(const M& m) { return (V)m; }
inline M truth(const V& v) { return (M)v; }
inline Vec vec(const V& a) { return Vec::loadu(&a); }
inline V raw(const Vec& a) { V r; a.store(&r); return r; }
inline int lanes(const M& m) { return ~vec((V)m).zero_mask() & ((1 << W) - 1); }
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
// FUNCTIONS
}  // namespace
