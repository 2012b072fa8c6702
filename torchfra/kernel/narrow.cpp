// One track at a time, by the mathematics of C++ alone.
namespace {
constexpr int64_t W = 1;
using V = Scalar;
using M = bool;

inline V all(Scalar a) { return a; }
template <class T = Scalar> inline V get(const Port& p, int64_t entry, const Block& at) {
  return static_cast<V>(*at_<T>(p, entry, at));
}
inline V load(const Port& p, int64_t entry, const Block& at) { return get(p, entry, at); }
inline void put(const Port& p, int64_t entry, V v, const Block& at) { *at_<Scalar>(p, entry, at) = v; }
inline void mark(const Port& p, int64_t entry, M v, const Block& at) { *at_<bool>(p, entry, at) = v; }
inline bool any(M m) { return m; }
// FUNCTIONS
}  // namespace
