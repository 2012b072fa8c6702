// One track at a time, by the mathematics of C++ alone.
#define LANES1(ours, name) \
  static INLINE SCALAR ours(SCALAR a) { return ::name(a); }
#define LANES2(ours, name) \
  static INLINE SCALAR ours(SCALAR a, SCALAR b) { return ::name(a, b); }
#define FUNCTION1(ours, name, off) LANES1(ours, name)
#define FUNCTION2(ours, name, off) LANES2(ours, name)
LANES1(sqrt_, sqrt)
LANES1(abs_, fabs)
LANES2(atan2_, atan2)
LANES1(exp_, exp)
LANES1(log_, log)

namespace {
using V = Scalar;
using M = bool;

INLINE V all(Scalar a) { return a; }
template <class T> INLINE V get(const Entries<T>& x, int64_t entry) { return static_cast<V>(*x[entry]); }
INLINE V load(const Entries<Scalar>& x, int64_t entry) { return get(x, entry); }
INLINE void put(const Entries<Scalar>& x, int64_t entry, V v) { *x[entry] = v; }
INLINE void write(const Entries<Scalar>& x, int64_t entry, V v) { *x[entry] = v; }
INLINE void mark(const Entries<bool>& x, int64_t entry, M v) { *x[entry] = v; }
INLINE V kept(M m) { return m; }
INLINE M truth(V v) { return v != 0; }
INLINE bool within(V a, Scalar least, Scalar most) { return !(a < least) & !(a > most); }
}  // namespace
