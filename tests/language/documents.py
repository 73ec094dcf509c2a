"""Short documents that the tests of mistakes, round trips and mutations begin from."""

FIELD = """\
maximize area;
variable a in [0, 9];
variable b in [0, 9];
constraint round <= 8;
input a, b;
output area, round;
area = a*b;
round = 2*a + 2*b;
"""

ARX = """\
minimize error;
variable a in [-2, 2];
variable gain: g in [0, 5];
constraint end in [-1, 1];
input a[I], g, u[T] = [1, 0, 0, 1, 1, 0, 1, 0], first = 0.5;
output error, y[T], end;
parameter seen[T] = [0.5, 0.2, 0.7, 0.9, 0.4, 1.1, 1.2, 0.8], order = 2;
set T = |0:7|;
set I = |1:order|;
real past[T];
y[t] = first foreach t in |0:order-1|;
past[t] = sum(i in I | a[i]*y[t-i]) foreach t in |order:7|;
y[t] = past[t] + g*u[t-1] foreach t in |order:7|;
past[t] = 0 foreach t in |0:order-1|;
error = sum(t in T | (y[t] - seen[t])^2);
end = y[7] - y[6];
"""

STATES = """\
minimize cost;
variable u in [-1, 1];
input u[T];
output cost, x[T, 2];
parameter A[2, 2] = [1, 0.1, -0.2, 0.9], B[2] = [0, 1];
set T = |0:5|;
set L = |1:5|;
x[0, :] = B;
x[t, :] = A@x[t-1, :] + B*u[t-1] foreach t in L;
cost = sum(t in T | dot(x[t, :], x[t, :])) + 0.1*sum(u*u);
"""

WIRED = """\
minimize miss;
variable weights in [-5, 5] random [-1, 1] seed 4;
variable bias in [-1, 1] random [-1, 1] seed 5;
constraint slope <= 0;
network net {
  input c (layer = front, scale = 2);
  output A (layer = back);
  gain dA (order = 1, type = local, dy = A, da = c);
  layer front (size = 1, type = identity);
  layer middle (size = 2, type = tanh);
  layer back (size = 1, type = linear);
  connection front -> middle;
  connection middle -> back;
}
mapping optics {
  input A, k = 2;
  output size, twice;
  size = sqrt(A^2 + k);
  twice = 2*size;
}
input weights[W], bias;
output miss, slope[K];
set K = |1:4|;
set W = |0:6|;
parameter wanted[K] = [2, 1.8, 1.5, 1.4];
real A[K], size[K], sharp[K];
net(weights[i] = weights[i] foreach i in W; c = k :: A[k] = A; slope[k] = dA) foreach k in K;
optics(A = A[k] + bias :: size[k] = size; sharp[k] = gain(size, k)) foreach k in K;
miss = sum(k in K | (size[k] - wanted[k])^2) + 0*sum(sharp);
"""

SHAPES = """\
minimize far;
variable p in [0.1, 4] random [1, 2] seed 1;
input p[N];
output far, area;
set N = |1:4|;
set M = |1:3|;
function square(x) = x^2;
function norm2(x, y) = sqrt(square(x) + square(y));
parameter origin = 1.5, table[N, M] = [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12];
real step[M], corner[N], sorted;
step[m] = p[m+1] - p[m] foreach m in M;
foreach n in N {
  corner[n] = norm2(p[n] - origin, sum(m in M | table[n, m])/60);
}
sorted = max(p[1], p[2], p[3]) - min(n in N | p[n]);
area = prod(n in N | p[n]) + log(p[1]);
far = sum(n in N | corner[n]^2) + sum(m in M | step[m]^2) + sorted^2;
"""

GROWTH = """\
minimize gap: difference weight 2;
variable rate = 0.5 in [0, 3];
variable start = 1 in [0, inf];
mapping years;
mapping season {
  input before, rate;
  output after;
  real shrink;
  after = before + rate*before*(1 - shrink);
  shrink = before/10;
}
input rate, start;
output difference, size[Y];
set Y = |2000:2010|;
set Later = |2001:2010|;
size[2000] = start;
season(before = size[y-1]; rate = rate :: size[y] = after) foreach y in Later;
difference = (size[2010] - 8)^2 + (size[2005] - 4)^2;
"""

SHORT = {
    "field": FIELD,
    "arx": ARX,
    "states": STATES,
    "wired": WIRED,
    "shapes": SHAPES,
    "growth": GROWTH,
}
