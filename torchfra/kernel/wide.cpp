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
template <class T = Scalar> __attribute__((noinline)) V get(const Port& p, int64_t entry, const Block& at) {
  const T* from = at_<T>(p, entry, at);
  if (p.track == 0) return all(*from);
  V v;
  for (int64_t i = 0; i < W; i++) v[i] = from[(i < at.lanes ? i : at.lanes - 1) * p.track];
  return v;
}
inline V load(const Port& p, int64_t entry, const Block& at) {
  if (at.lanes < W) return get(p, entry, at);
  V v;
  __builtin_memcpy(&v, at_<Scalar>(p, entry, at), sizeof v);
  return v;
}
inline void put(const Port& p, int64_t entry, const V& v, const Block& at) {
  __builtin_memcpy(at_<Scalar>(p, entry, at), &v, at.lanes < W ? at.lanes * sizeof(Scalar) : sizeof v);
}
inline void mark(const Port& p, int64_t entry, const M& v, const Block& at) {
  bool* to = at_<bool>(p, entry, at);
  for (int64_t i = 0; i < at.lanes; i++) to[i] = v[i] != 0;
}
inline Vec vec(const V& a) { return Vec::loadu(&a); }
inline V raw(const Vec& a) { V r; a.store(&r); return r; }
inline bool any(const M& m) { return vec((V)m).zero_mask() != (1 << W) - 1; }
// FUNCTIONS
}  // namespace
