// One track at a time, by the mathematics of C++ alone.
namespace {
constexpr int64_t W = 1;
using V = Scalar;
using M = bool;

inline V all(Scalar a) { return a; }
template <class T> inline V get(const Entries<T>& x, int64_t entry) { return static_cast<V>(*x[entry]); }
inline V load(const Entries<Scalar>& x, int64_t entry) { return get(x, entry); }
inline void put(const Entries<Scalar>& x, int64_t entry, V v) { *x[entry] = v; }
inline void mark(const Entries<bool>& x, int64_t entry, M v) { *x[entry] = v; }
inline V kept(M m) { return m; }
inline M truth(V v) { return v != 0; }
inline bool any(M m) { return m; }
template <int64_t PLACES> inline void guarded(
    V (*s)[PLACES], int64_t, int place, bool value, void (*region)(V*), const Values&, const Values&) {
  if (truth(s[0][place]) == value) region(s[0]);
}
// FUNCTIONS
}  // namespace
