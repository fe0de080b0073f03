// The yardstick of benchmarks/raster.py: a single-purpose C++ rasterizer (AVX2, OpenMP), with the
// conventions of ahoy_core.splat and three colours only. Not part of the library: it answers "how fast could this be?".
// Built by the benchmark: g++ -O3 -march=native -ffast-math -fno-finite-math-only -fopenmp -shared -fPIC
#include <immintrin.h>
#include <omp.h>
#include <time.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>
static double now() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}
#if defined(USE512)
#define VW 16
struct M {
  __mmask16 m;
};
struct V {
  __m512 v;
  V() {}
  V(__m512 a) : v(a) {}
  V(float f) : v(_mm512_set1_ps(f)) {}
};
static inline V ld(const float* p) { return _mm512_load_ps(p); }
static inline void st(float* p, V a) { _mm512_store_ps(p, a.v); }
static inline V fma(V a, V b, V c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
static inline V fnma(V a, V b, V c) { return _mm512_fnmadd_ps(a.v, b.v, c.v); }
static inline V operator*(V a, V b) { return _mm512_mul_ps(a.v, b.v); }
static inline V operator+(V a, V b) { return _mm512_add_ps(a.v, b.v); }
static inline V operator-(V a, V b) { return _mm512_sub_ps(a.v, b.v); }
static inline V vmin(V a, V b) { return _mm512_min_ps(a.v, b.v); }
static inline V vmax(V a, V b) { return _mm512_max_ps(a.v, b.v); }
static inline M ge(V a, V b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
static inline M gt(V a, V b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
static inline M operator&(M a, M b) { return {(__mmask16)(a.m & b.m)}; }
static inline bool any(M a) { return a.m; }
static inline int cnt(M a) { return __builtin_popcount(a.m); }
static inline V sel(M m, V a, V b) { return _mm512_mask_mov_ps(b.v, m.m, a.v); }
static inline V zif(M m, V a) { return _mm512_maskz_mov_ps(m.m, a.v); }
static inline V rcp(V a) {
  __m512 r = _mm512_rcp14_ps(a.v);
  return _mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.f)));
}
static inline V neg(V a) { return _mm512_sub_ps(_mm512_setzero_ps(), a.v); }
static inline float hsum(V a) { return _mm512_reduce_add_ps(a.v); }
static inline V exp2v(V p) {
  __m512 n = _mm512_roundscale_ps(p.v, 8);
  __m512 f = _mm512_sub_ps(p.v, n);
  __m512 r = _mm512_set1_ps(1.3333558e-3f);
  r = _mm512_fmadd_ps(r, f, _mm512_set1_ps(9.6181291e-3f));
  r = _mm512_fmadd_ps(r, f, _mm512_set1_ps(5.5504109e-2f));
  r = _mm512_fmadd_ps(r, f, _mm512_set1_ps(2.4022651e-1f));
  r = _mm512_fmadd_ps(r, f, _mm512_set1_ps(6.9314718e-1f));
  r = _mm512_fmadd_ps(r, f, _mm512_set1_ps(1.f));
  return _mm512_scalef_ps(r, n);
}
#else
#define VW 8
struct M {
  __m256 m;
};
struct V {
  __m256 v;
  V() {}
  V(__m256 a) : v(a) {}
  V(float f) : v(_mm256_set1_ps(f)) {}
};
static inline V ld(const float* p) { return _mm256_load_ps(p); }
static inline void st(float* p, V a) { _mm256_store_ps(p, a.v); }
static inline V fma(V a, V b, V c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
static inline V fnma(V a, V b, V c) { return _mm256_fnmadd_ps(a.v, b.v, c.v); }
static inline V operator*(V a, V b) { return _mm256_mul_ps(a.v, b.v); }
static inline V operator+(V a, V b) { return _mm256_add_ps(a.v, b.v); }
static inline V operator-(V a, V b) { return _mm256_sub_ps(a.v, b.v); }
static inline V vmin(V a, V b) { return _mm256_min_ps(a.v, b.v); }
static inline V vmax(V a, V b) { return _mm256_max_ps(a.v, b.v); }
static inline M ge(V a, V b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)}; }
static inline M gt(V a, V b) { return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)}; }
static inline M operator&(M a, M b) { return {_mm256_and_ps(a.m, b.m)}; }
static inline bool any(M a) { return _mm256_movemask_ps(a.m); }
static inline int cnt(M a) { return __builtin_popcount(_mm256_movemask_ps(a.m)); }
static inline V sel(M m, V a, V b) { return _mm256_blendv_ps(b.v, a.v, m.m); }
static inline V zif(M m, V a) { return _mm256_and_ps(m.m, a.v); }
static inline V rcp(V a) {
  __m256 r = _mm256_rcp_ps(a.v);
  return _mm256_mul_ps(r, _mm256_fnmadd_ps(a.v, r, _mm256_set1_ps(2.f)));
}
static inline V neg(V a) { return _mm256_sub_ps(_mm256_setzero_ps(), a.v); }
static inline float hsum(V a) {
  __m128 x = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  x = _mm_add_ps(x, _mm_movehl_ps(x, x));
  x = _mm_add_ss(x, _mm_movehdup_ps(x));
  return _mm_cvtss_f32(x);
}
static inline V exp2v(V p) {
  __m256 n = _mm256_round_ps(p.v, 8);
  __m256 f = _mm256_sub_ps(p.v, n);
  __m256 r = _mm256_set1_ps(1.3333558e-3f);
  r = _mm256_fmadd_ps(r, f, _mm256_set1_ps(9.6181291e-3f));
  r = _mm256_fmadd_ps(r, f, _mm256_set1_ps(5.5504109e-2f));
  r = _mm256_fmadd_ps(r, f, _mm256_set1_ps(2.4022651e-1f));
  r = _mm256_fmadd_ps(r, f, _mm256_set1_ps(6.9314718e-1f));
  r = _mm256_fmadd_ps(r, f, _mm256_set1_ps(1.f));
  __m256i e = _mm256_slli_epi32(_mm256_cvtps_epi32(n), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(r), e));
}
#endif
static const int TS = 16;
static const float LOG2E = 1.44269504f, PTH = -7.99435344f;  // log2(1/255)
struct alignas(64) G {
  float mx, my, A, B, C, lop, r, g, b, hx, hy, qmax, a, bb, c, op;
};
struct Ctx {
  int N, W, H, tw, th, nv;
  std::vector<G> g;
  std::vector<int> vis;
  std::vector<int> off, ids;
  std::vector<float> Tf;
  std::vector<int> last;
  double t[8];
  long st[8];
};
static inline void qrot(const float* q, float* R, float& inv, float* qn) {
  inv = 1.f / std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  float w = q[0] * inv, x = q[1] * inv, y = q[2] * inv, z = q[3] * inv;
  qn[0] = w;
  qn[1] = x;
  qn[2] = y;
  qn[3] = z;
  R[0] = 1 - 2 * (y * y + z * z);
  R[1] = 2 * (x * y - w * z);
  R[2] = 2 * (x * z + w * y);
  R[3] = 2 * (x * y + w * z);
  R[4] = 1 - 2 * (x * x + z * z);
  R[5] = 2 * (y * z - w * x);
  R[6] = 2 * (x * z - w * y);
  R[7] = 2 * (y * z + w * x);
  R[8] = 1 - 2 * (x * x + y * y);
}
static inline bool tilehit(const G& g, float x0, float y0, float x1,
                           float y1) {  // min of quadratic over box <= qmax  (box = pixel centres)
  float cx = std::min(std::max(g.mx, x0), x1), cy = std::min(std::max(g.my, y0), y1);
  if (cx == g.mx && cy == g.my) return true;
  float q = 1e30f;
  if (cx != g.mx) {
    float dx = cx - g.mx;
    float dy = -g.B * dx / (2 * g.C);
    dy = std::min(std::max(dy, y0 - g.my), y1 - g.my);
    q = g.A * dx * dx + g.B * dx * dy + g.C * dy * dy;
  }
  if (cy != g.my) {
    float dy = cy - g.my;
    float dx = -g.B * dy / (2 * g.A);
    dx = std::min(std::max(dx, x0 - g.mx), x1 - g.mx);
    q = std::min(q, g.A * dx * dx + g.B * dx * dy + g.C * dy * dy);
  }
  return q <= g.qmax;
}
extern "C" {
Ctx* ctx_new() { return new Ctx(); }
void ctx_free(Ctx* c) { delete c; }
double ctx_t(Ctx* c, int i) { return c->t[i]; }
long ctx_s(Ctx* c, int i) { return c->st[i]; }
void fwd(Ctx* c, int N, const float* mean, const float* quat, const float* scale, const float* op, const float* col,
         const float* Vm, const float* K, int W, int H, const float* bg, float* img, float* alpha, int stats) {
  double t0 = now();
  c->N = N;
  c->W = W;
  c->H = H;
  c->tw = (W + TS - 1) / TS;
  c->th = (H + TS - 1) / TS;
  int tw = c->tw, th = c->th, nt = tw * th;
  c->g.resize(N);
  std::vector<uint32_t> key(N);
  float fx = K[0], fy = K[4], cx = K[2], cy = K[5];
  float R[9] = {Vm[0], Vm[1], Vm[2], Vm[4], Vm[5], Vm[6], Vm[8], Vm[9], Vm[10]}, t[3] = {Vm[3], Vm[7], Vm[11]};
  float lxp = (W - cx) / fx + .15f * W / fx, lxn = cx / fx + .15f * W / fx, lyp = (H - cy) / fy + .15f * H / fy,
        lyn = cy / fy + .15f * H / fy;
#pragma omp parallel for schedule(static)
  for (int i = 0; i < N; i++) {
    const float* m = mean + 3 * i;
    float z = R[6] * m[0] + R[7] * m[1] + R[8] * m[2] + t[2];
    G& g = c->g[i];
    key[i] = 0xffffffffu;
    if (!(z > 0.01f)) continue;
    float tx = R[0] * m[0] + R[1] * m[1] + R[2] * m[2] + t[0], ty = R[3] * m[0] + R[4] * m[1] + R[5] * m[2] + t[1];
    float qn[4], inv, Q[9];
    qrot(quat + 4 * i, Q, inv, qn);
    float s[3] = {scale[3 * i], scale[3 * i + 1], scale[3 * i + 2]};
    float rz = 1 / z;
    float ux = std::min(std::max(tx * rz, -lxn), lxp), uy = std::min(std::max(ty * rz, -lyn), lyp);
    float j0 = fx * rz, j2 = -fx * ux * rz, k1 = fy * rz, k2 = -fy * uy * rz;
    float T0[3], T1[3];
    for (int k = 0; k < 3; k++) {
      T0[k] = j0 * R[k] + j2 * R[6 + k];
      T1[k] = k1 * R[3 + k] + k2 * R[6 + k];
    }
    float xx = .3f, xy = 0, yy = .3f;
    for (int k = 0; k < 3; k++) {
      float u = (T0[0] * Q[k] + T0[1] * Q[3 + k] + T0[2] * Q[6 + k]) * s[k],
            v = (T1[0] * Q[k] + T1[1] * Q[3 + k] + T1[2] * Q[6 + k]) * s[k];
      xx += u * u;
      xy += u * v;
      yy += v * v;
    }
    float det = xx * yy - xy * xy;
    if (!(det > 0)) continue;
    float id = 1 / det;
    float o = op[i];
    g.lop = std::log2(o);
    g.qmax = g.lop - PTH;
    if (!(g.qmax > 0)) continue;
    float ex = std::sqrt(2 * g.qmax / LOG2E);
    g.hx = ex * std::sqrt(xx);
    g.hy = ex * std::sqrt(yy);
    g.mx = fx * tx * rz + cx;
    g.my = fy * ty * rz + cy;
    if (g.mx + g.hx < 0 || g.mx - g.hx > W || g.my + g.hy < 0 || g.my - g.hy > H) continue;
    g.a = yy * id;
    g.bb = -xy * id;
    g.c = xx * id;
    g.op = o;
    g.A = .5f * LOG2E * g.a;
    g.B = LOG2E * g.bb;
    g.C = .5f * LOG2E * g.c;
    g.r = col[3 * i];
    g.g = col[3 * i + 1];
    g.b = col[3 * i + 2];
    memcpy(&key[i], &z, 4);
  }
  double t1 = now();
  std::vector<uint64_t> a;
  a.reserve(N);
  for (int i = 0; i < N; i++)
    if (key[i] != 0xffffffffu) a.push_back((uint64_t)key[i] << 32 | i);
  int nv = c->nv = a.size();
  std::vector<uint64_t> b(nv);
  for (int sh = 32; sh < 64; sh += 11) {
    uint32_t h[2049] = {0};
    for (auto x : a) h[((x >> sh) & 2047) + 1]++;
    for (int i = 0; i < 2048; i++) h[i + 1] += h[i];
    for (auto x : a) b[h[(x >> sh) & 2047]++] = x;
    a.swap(b);
  }
  double t2 = now();
  int nth = omp_get_max_threads();
  std::vector<std::vector<int>> cn(nth, std::vector<int>(nt, 0));
  std::vector<std::vector<std::pair<int, int>>> prs(nth);
  c->off.assign(nt + 1, 0);
#pragma omp parallel num_threads(nth)
  {
    int id = omp_get_thread_num();
    int s = (long)nv * id / nth, e = (long)nv * (id + 1) / nth;
    auto& h = cn[id];
    auto& pr = prs[id];
    pr.reserve((e - s) * 6 + 16);
    for (int k = s; k < e; k++) {
      int i = (int)(uint32_t)a[k];
      const G& g = c->g[i];
      int x0 = std::max(0, (int)std::floor((g.mx - g.hx - .5f) / TS)),
          x1 = std::min(tw - 1, (int)std::floor((g.mx + g.hx - .5f) / TS)),
          y0 = std::max(0, (int)std::floor((g.my - g.hy - .5f) / TS)),
          y1 = std::min(th - 1, (int)std::floor((g.my + g.hy - .5f) / TS));
      bool small = (x0 == x1) && (y0 == y1);
      for (int y = y0; y <= y1; y++)
        for (int x = x0; x <= x1; x++) {
          if (small || tilehit(g, x * TS + .5f, y * TS + .5f, x * TS + 15.5f, y * TS + 15.5f)) {
            h[y * tw + x]++;
            pr.push_back({y * tw + x, i});
          }
        }
    }
  }
  {
    int s = 0;
    for (int q = 0; q < nt; q++) {
      c->off[q] = s;
      for (int p = 0; p < nth; p++) {
        int v = cn[p][q];
        cn[p][q] = s;
        s += v;
      }
    }
    c->off[nt] = s;
    c->ids.resize(s);
  }
#pragma omp parallel num_threads(nth)
  {
    int id = omp_get_thread_num();
    auto& h = cn[id];
    for (auto& p : prs[id]) c->ids[h[p.first]++] = p.second;
  }
  double t3 = now();
  c->Tf.resize((size_t)nt * 256);
  c->last.resize((size_t)nt * 256);
  long ev = 0, bl = 0, lanes = 0;
#pragma omp parallel for schedule(dynamic, 4) reduction(+ : ev, bl, lanes)
  for (int q = 0; q < nt; q++) {
    int X = q % tw * TS, Y = q / tw * TS;
    alignas(64) float T[256], Cr[256], Cg[256], Cb[256], L[256], xs[16];
    for (int i = 0; i < 256; i++) {
      T[i] = 1;
      Cr[i] = Cg[i] = Cb[i] = 0;
      L[i] = -1;
    }
    for (int i = 0; i < 16; i++) xs[i] = X + i + .5f;
    int s = c->off[q], e = c->off[q + 1];
    float ycl = std::min(16, H - Y);
    for (int k = s; k < e; k++) {
      if (k + 4 < e) __builtin_prefetch(&c->g[c->ids[k + 4]]);
      const G& g = c->g[c->ids[k]];
      int r0 = std::max(0, (int)std::ceil(g.my - g.hy - .5f - Y)),
          r1 = std::min((int)ycl - 1, (int)std::floor(g.my + g.hy - .5f - Y));
      float kk = (float)(k - s);
      for (int hb = 0; hb < 16; hb += VW) {
        if (VW == 8) {
          if (g.mx + g.hx < X + hb || g.mx - g.hx > X + hb + 8) continue;
        }
        V dx = ld(xs + hb) - V(g.mx);
        V qx = fnma(V(g.A) * dx, dx, V(g.lop));
        V bx = neg(V(g.B) * dx);
        for (int r = r0; r <= r1; r++) {
          float dy = Y + r + .5f - g.my;
          V p = fma(bx, V(dy), qx - V(g.C * dy * dy));
          float* Tp = T + r * 16 + hb;
          V t = ld(Tp);
          M m = ge(p, V(PTH)) & gt(t, V(0.f));
          if (stats) {
            ev += VW;
          }
          if (!any(m)) continue;
          V al = vmin(exp2v(p), V(.999f));
          al = zif(m, al);
          V nt_ = fnma(al, t, t);
          M live = gt(nt_, V(1e-4f));  // not live -> done (only if m)
          if (stats) {
            lanes += VW;
            bl += cnt(m & live);
          }
          M ml = m & live;
          V w = zif(ml, al * t);
          float *pr = Cr + r * 16 + hb, *pg = Cg + r * 16 + hb, *pb = Cb + r * 16 + hb, *pl = L + r * 16 + hb;
          st(pr, fma(w, V(g.r), ld(pr)));
          st(pg, fma(w, V(g.g), ld(pg)));
          st(pb, fma(w, V(g.b), ld(pb)));
          st(pl, sel(ml, V(kk), ld(pl)));
          V tn = sel(live, nt_, sel(m, neg(t), t));
          st(Tp, tn);
        }
      }
      if (((k - s) & 15) == 15) {
        V mx = ld(T);
        for (int i = VW; i < 256; i += VW) mx = vmax(mx, ld(T + i));
        if (!any(gt(mx, V(0.f)))) break;
      }
    }
    int xc = std::min(16, W - X);
    for (int r = 0; r < ycl; r++)
      for (int i = 0; i < xc; i++) {
        int j = r * 16 + i;
        size_t o = (size_t)(Y + r) * W + X + i;
        float tf = std::fabs(T[j]);
        img[3 * o] = Cr[j] + tf * bg[0];
        img[3 * o + 1] = Cg[j] + tf * bg[1];
        img[3 * o + 2] = Cb[j] + tf * bg[2];
        alpha[o] = 1 - tf;
      }
    for (int j = 0; j < 256; j++) {
      c->Tf[(size_t)q * 256 + j] = std::fabs(T[j]);
      c->last[(size_t)q * 256 + j] = (int)L[j];
    }
  }
  double t4 = now();
  c->t[0] = t1 - t0;
  c->t[1] = t2 - t1;
  c->t[2] = t3 - t2;
  c->t[3] = t4 - t3;
  c->st[0] = c->ids.size();
  c->st[1] = ev;
  c->st[2] = lanes;
  c->st[3] = bl;
  c->st[4] = nv;
}
void bwd(Ctx* c, const float* mean, const float* quat, const float* scale, const float* Vm, const float* K,
         const float* bg, const float* vimg, const float* valpha, float* gm, float* gq, float* gs, float* go, float* gc,
         float* gV) {
  double t0 = now();
  int N = c->N, W = c->W, H = c->H, tw = c->tw, nt = c->tw * c->th;
  int nth = omp_get_max_threads();
  static std::vector<float> accs;
  accs.assign((size_t)nth * N * 12, 0.f);  // 9 used, padded to 12
#pragma omp parallel num_threads(nth)
  {
    float* acc = accs.data() + (size_t)omp_get_thread_num() * N * 12;
#pragma omp for schedule(dynamic, 4)
    for (int q = 0; q < nt; q++) {
      int X = q % tw * TS, Y = q / tw * TS;
      alignas(64) float T[256], S[256], vr[256], vg[256], vb[256], L[256], xs[16];
      int mxl = -1;
      for (int i = 0; i < 16; i++) xs[i] = X + i + .5f;
      int ycl = std::min(16, H - Y), xc = std::min(16, W - X);
      for (int r = 0; r < 16; r++)
        for (int i = 0; i < 16; i++) {
          int j = r * 16 + i;
          if (r < ycl && i < xc) {
            size_t o = (size_t)(Y + r) * W + X + i;
            vr[j] = vimg[3 * o];
            vg[j] = vimg[3 * o + 1];
            vb[j] = vimg[3 * o + 2];
            T[j] = c->Tf[(size_t)q * 256 + j];
            S[j] = T[j] * (bg[0] * vr[j] + bg[1] * vg[j] + bg[2] * vb[j] - (valpha ? valpha[o] : 0.f));
            int l = c->last[(size_t)q * 256 + j];
            L[j] = l;
            mxl = std::max(mxl, l);
          } else {
            vr[j] = vg[j] = vb[j] = S[j] = 0;
            T[j] = 1;
            L[j] = -1;
          }
        }
      int s = c->off[q];
      for (int k = s + mxl; k >= s; k--) {
        if (k - 4 >= s) __builtin_prefetch(&c->g[c->ids[k - 4]]);
        int id = c->ids[k];
        const G& g = c->g[id];
        int r0 = std::max(0, (int)std::ceil(g.my - g.hy - .5f - Y)),
            r1 = std::min(ycl - 1, (int)std::floor(g.my + g.hy - .5f - Y));
        V kk((float)(k - s));
        V ar(0.f), ag(0.f), ab(0.f), h0(0.f), h1(0.f), h2(0.f), h3(0.f), h4(0.f), h5(0.f);
        bool hit = false;
        for (int hb = 0; hb < 16; hb += VW) {
          if (VW == 8) {
            if (g.mx + g.hx < X + hb || g.mx - g.hx > X + hb + 8) continue;
          }
          V dx = ld(xs + hb) - V(g.mx);
          V qx = fnma(V(g.A) * dx, dx, V(g.lop));
          V bx = neg(V(g.B) * dx);
          for (int r = r0; r <= r1; r++) {
            int o = r * 16 + hb;
            float dy = Y + r + .5f - g.my;
            V p = fma(bx, V(dy), qx - V(g.C * dy * dy));
            M m = ge(p, V(PTH)) & ge(ld(L + o), kk);
            if (!any(m)) continue;
            hit = true;
            V raw = exp2v(p);
            V al = zif(m, vmin(raw, V(.999f)));
            V ra = rcp(V(1.f) - al);
            V t = ld(T + o) * ra;
            st(T + o, t);
            V w = al * t;
            V a = ld(vr + o), b = ld(vg + o), d = ld(vb + o);
            V gd = fma(V(g.r), a, fma(V(g.g), b, V(g.b) * d));
            V Sv = ld(S + o);
            V da = fma(t, gd, neg(Sv * ra));
            st(S + o, fma(w, gd, Sv));
            ar = fma(w, a, ar);
            ag = fma(w, b, ag);
            ab = fma(w, d, ab);
            V h = zif(ge(V(.999f), raw), da * al);
            V hx = h * dx, hy = h * V(dy);
            h0 = h0 + h;
            h1 = h1 + hx;
            h2 = h2 + hy;
            h3 = fma(hx, dx, h3);
            h4 = fma(hx, V(dy), h4);
            h5 = fma(hy, V(dy), h5);
          }
        }
        if (hit) {
          float* A = acc + (size_t)id * 12;
          A[0] += hsum(ar);
          A[1] += hsum(ag);
          A[2] += hsum(ab);
          A[3] += hsum(h0);
          A[4] += hsum(h1);
          A[5] += hsum(h2);
          A[6] += hsum(h3);
          A[7] += hsum(h4);
          A[8] += hsum(h5);
        }
      }
    }
  }
  double t1 = now();
  float fx = K[0], fy = K[4], cx = K[2], cy = K[5];
  float R[9] = {Vm[0], Vm[1], Vm[2], Vm[4], Vm[5], Vm[6], Vm[8], Vm[9], Vm[10]}, tt[3] = {Vm[3], Vm[7], Vm[11]};
  float lxp = (W - cx) / fx + .15f * W / fx, lxn = cx / fx + .15f * W / fx, lyp = (H - cy) / fy + .15f * H / fy,
        lyn = cy / fy + .15f * H / fy;
  std::vector<double> pose((size_t)nth * 16, 0.0);
#pragma omp parallel num_threads(nth)
  {
    double* P = &pose[(size_t)omp_get_thread_num() * 16];
#pragma omp for schedule(static)
    for (int i = 0; i < N; i++) {
      float A[9] = {0};
      bool nz = false;
      for (int p = 0; p < nth; p++) {
        const float* s = accs.data() + ((size_t)p * N + i) * 12;
        for (int k = 0; k < 9; k++) {
          A[k] += s[k];
          nz |= s[k] != 0;
        }
      }
      for (int k = 0; k < 3; k++) gc[3 * i + k] = A[k];
      if (!nz) {
        for (int k = 0; k < 3; k++) gm[3 * i + k] = gs[3 * i + k] = 0;
        for (int k = 0; k < 4; k++) gq[4 * i + k] = 0;
        go[i] = 0;
        continue;
      }
      const G& g = c->g[i];
      go[i] = A[3] / g.op;
      float gmx = g.a * A[4] + g.bb * A[5], gmy = g.bb * A[4] + g.c * A[5];
      float Ga = -.5f * A[6], Gb = -.5f * A[7], Gc = -.5f * A[8];  // sym matrix entries
      // dSigma=-Q G Q
      float q00 = g.a, q01 = g.bb, q11 = g.c;
      float u00 = q00 * Ga + q01 * Gb, u01 = q00 * Gb + q01 * Gc, u10 = q01 * Ga + q11 * Gb, u11 = q01 * Gb + q11 * Gc;
      float S00 = -(u00 * q00 + u01 * q01), S01 = -(u00 * q01 + u01 * q11), S11 = -(u10 * q01 + u11 * q11);
      const float* m = mean + 3 * i;
      float tx = R[0] * m[0] + R[1] * m[1] + R[2] * m[2] + tt[0], ty = R[3] * m[0] + R[4] * m[1] + R[5] * m[2] + tt[1],
            z = R[6] * m[0] + R[7] * m[1] + R[8] * m[2] + tt[2];
      float rz = 1 / z, ux = tx * rz, uy = ty * rz;
      bool cxl = ux < -lxn || ux > lxp, cyl = uy < -lyn || uy > lyp;
      ux = std::min(std::max(ux, -lxn), lxp);
      uy = std::min(std::max(uy, -lyn), lyp);
      float j0 = fx * rz, j2 = -fx * ux * rz, k1 = fy * rz, k2 = -fy * uy * rz;
      float qn[4], inv, Q[9];
      qrot(quat + 4 * i, Q, inv, qn);
      const float* s = scale + 3 * i;
      float RQ[9];
      for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++)
          RQ[a * 3 + b] = (R[a * 3] * Q[b] + R[a * 3 + 1] * Q[3 + b] + R[a * 3 + 2] * Q[6 + b]) * s[b];  // Mc = R Q S
      float u[3], v[3];
      for (int k = 0; k < 3; k++) {
        u[k] = j0 * RQ[k] + j2 * RQ[6 + k];
        v[k] = k1 * RQ[3 + k] + k2 * RQ[6 + k];
      }
      // B=J Mc (2x3); Sigma=BB^T ; dB=2 G B
      float du[3], dv[3];
      for (int k = 0; k < 3; k++) {
        du[k] = 2 * (S00 * u[k] + S01 * v[k]);
        dv[k] = 2 * (S01 * u[k] + S11 * v[k]);
      }
      float dj0 = 0, dj2 = 0, dk1 = 0, dk2 = 0;
      float dMc[9];
      for (int k = 0; k < 3; k++) {
        dj0 += du[k] * RQ[k];
        dj2 += du[k] * RQ[6 + k];
        dk1 += dv[k] * RQ[3 + k];
        dk2 += dv[k] * RQ[6 + k];
        dMc[k] = j0 * du[k];
        dMc[3 + k] = k1 * dv[k];
        dMc[6 + k] = j2 * du[k] + k2 * dv[k];
      }
      float dtx = fx * rz * gmx, dty = fy * rz * gmy, dz = -(fx * tx * gmx + fy * ty * gmy) * rz * rz;
      dz += -fx * rz * rz * dj0 - fy * rz * rz * dk1;
      if (!cxl) {
        dtx += -fx * rz * rz * dj2;
        dz += 2 * fx * ux * rz * rz * dj2;
      } else dz += fx * ux * rz * rz * dj2;
      if (!cyl) {
        dty += -fy * rz * rz * dk2;
        dz += 2 * fy * uy * rz * rz * dk2;
      } else dz += fy * uy * rz * rz * dk2;
      float dt[3] = {dtx, dty, dz};
      for (int k = 0; k < 3; k++) gm[3 * i + k] = R[k] * dt[0] + R[3 + k] * dt[1] + R[6 + k] * dt[2];
      // dMc -> d(QS)=R^T dMc ; dR += dMc (QS)^T + dt m^T
      float dQ[9];
      for (int a = 0; a < 3; a++)
        for (int b = 0; b < 3; b++) dQ[a * 3 + b] = R[a] * dMc[b] + R[3 + a] * dMc[3 + b] + R[6 + a] * dMc[6 + b];
      for (int a = 0; a < 3; a++) {
        for (int b = 0; b < 3; b++)
          P[a * 4 + b] += dt[a] * m[b] + dMc[a * 3] * Q[b * 3] * s[0] + dMc[a * 3 + 1] * Q[b * 3 + 1] * s[1] +
                          dMc[a * 3 + 2] * Q[b * 3 + 2] * s[2];
        P[a * 4 + 3] += dt[a];
      }
      for (int b = 0; b < 3; b++) {
        gs[3 * i + b] = dQ[b] * Q[b] + dQ[3 + b] * Q[3 + b] + dQ[6 + b] * Q[6 + b];
        for (int a = 0; a < 3; a++) dQ[a * 3 + b] *= s[b];
      }
      float w = qn[0], x = qn[1], y = qn[2], zz = qn[3];
      float d[4] = {2 * (x * (dQ[7] - dQ[5]) + y * (dQ[2] - dQ[6]) + zz * (dQ[3] - dQ[1])),
                    2 * (-2 * x * (dQ[4] + dQ[8]) + y * (dQ[1] + dQ[3]) + zz * (dQ[2] + dQ[6]) + w * (dQ[7] - dQ[5])),
                    2 * (x * (dQ[1] + dQ[3]) - 2 * y * (dQ[0] + dQ[8]) + zz * (dQ[5] + dQ[7]) + w * (dQ[2] - dQ[6])),
                    2 * (x * (dQ[2] + dQ[6]) + y * (dQ[5] + dQ[7]) - 2 * zz * (dQ[0] + dQ[4]) + w * (dQ[3] - dQ[1]))};
      float dd = d[0] * w + d[1] * x + d[2] * y + d[3] * zz;
      for (int k = 0; k < 4; k++) gq[4 * i + k] = (d[k] - qn[k] * dd) * inv;
    }
  }
  for (int k = 0; k < 16; k++) {
    double s = 0;
    for (int p = 0; p < nth; p++) s += pose[p * 16 + k];
    gV[k] = s;
  }
  double t2 = now();
  c->t[4] = t1 - t0;
  c->t[5] = t2 - t1;
}
void setth(int n) { omp_set_num_threads(n); }
}
