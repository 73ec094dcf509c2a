# The beam matrix and the calibration of a quadrupole from one scan (report, Appendix C).
minimize obj;
variable s_11 in [0, 10000] random [0, 10] seed 11;
variable s_12 in [0, 10000] random [0, 10] seed 12;
variable s_22 in [0, 10000] random [0, 10] seed 21;
variable slope_q3 in [160.87, 160.87] random [0, 500] seed 31;
variable int_q3 in [49, 49] random [0, 100] seed 32;
variable slope_q4 in [147.23, 187.23] random [167.23, 167.23] seed 41;
variable int_q4 in [23.17, 63.17] random [43.17, 43.17] seed 42;
solver "com.pav.pdas.optimization.snopt.SnoptDirect" {
  "major feasibility tolerance" = 1e-6;
  "major optimality tolerance" = 1e-6;
  "major step limit" = 0.1;
  "major print level" = 1;
  "print file" = 6;
  solution = true;
  "solution file" = 6;
  "scale option" = 2;
}
mapping trainer;

table d = "fitdata.csv" [14, 23];
mapping Transfer {
  mapping QuadTransfer {
    input I_2, slope_q3, int_q3, slope_q4, int_q4;
    output A_T, B_T, C_T, D_T;
    parameter E_slice = 30.5, A_spec = 0.953728998305, B_spec = 0.418879020479,
      C_spec = -0.682448955752, D_spec = 0.74878340824, l_eff = 0.07677, I_Qy = 0;
    real l_qtq, l_drift1, l_drift2, K_1, K_2, A_quad, B_quad, C_quad, D_quad;
    l_drift1 = 1.873 - l_eff/2;
    l_drift2 = 0.4191;
    l_qtq = 4.36 - 4.173 - l_eff;
    K_1 = sqrt((slope_q3*I_Qy + int_q3)/E_slice);
    K_2 = sqrt((slope_q4*I_2 + int_q4)/E_slice);
    A_quad = cos(K_2*l_eff)*(cosh(K_1*l_eff) + l_qtq*K_1*sinh(K_1*l_eff)) + K_1/K_2*sin(K_2*l_eff)*sinh(K_1*l_eff);
    B_quad = cos(K_2*l_eff)*(sinh(K_1*l_eff)/K_1 + l_qtq*cosh(K_1*l_eff)) + 1/K_2*sin(K_2*l_eff)*cosh(K_1*l_eff);
    C_quad = -K_2*sin(K_2*l_eff)*(cosh(K_1*l_eff) + l_qtq*K_1*sinh(K_1*l_eff)) + K_1*cos(K_2*l_eff)*sinh(K_1*l_eff);
    D_quad = -K_2*sin(K_2*l_eff)*(sinh(K_1*l_eff)/K_1 + l_qtq*cosh(K_1*l_eff)) + cos(K_2*l_eff)*cosh(K_1*l_eff);
    A_T = A_spec*(A_quad + l_drift1*C_quad) + B_spec*C_quad + l_drift2*C_spec*(A_quad + l_drift1*C_quad) + l_drift2*D_spec*C_quad;
    B_T = A_spec*(B_quad + l_drift1*D_quad) + B_spec*D_quad + l_drift2*C_spec*(B_quad + l_drift1*D_quad) + l_drift2*D_spec*D_quad;
    C_T = C_spec*(A_quad + l_drift1*C_quad) + D_spec*C_quad;
    D_T = C_spec*(B_quad + l_drift1*D_quad) + D_spec*D_quad;
  }
  mapping BeamTransfer {
    input A_T, B_T, C_T, D_T, s_11, s_12, s_22;
    output dx, dxp;
    real dx2, dxp2;
    dx2 = A_T^2*s_11 + 2*A_T*B_T*s_12 + B_T^2*s_22;
    dxp2 = C_T^2*s_11 + 2*C_T*D_T*s_12 + D_T^2*s_22;
    dx = 1e2*sqrt(dx2);
    dxp = 1e2*sqrt(dxp2);
  }
  input I_2, s_11, s_12, s_22, slope_q3, int_q3, slope_q4, int_q4;
  output A_T, B_T, C_T, D_T, dx, dxp;
  QuadTransfer(I_2 = I_2; slope_q3 = slope_q3; int_q3 = int_q3; slope_q4 = slope_q4; int_q4 = int_q4 :: A_T = A_T; B_T = B_T; C_T = C_T; D_T = D_T);
  BeamTransfer(A_T = A_T; B_T = B_T; C_T = C_T; D_T = D_T; s_11 = s_11; s_12 = s_12; s_22 = s_22 :: dx = dx; dxp = dxp);
}
input s_11, s_12, s_22, slope_q3 = 160.87, int_q3 = 49, slope_q4 = 167.23, int_q4 = 43.17;
output obj, dx_model[K], dxp_model[K], A_T[K], B_T[K], C_T[K], D_T[K];
set K = |1:14|;
set J = |1:23|;
real data[K, J] = d, I_2[K], dx_measured[K], sdx_measured[K], error_linear[K],
  error_linear_ns[K], error_nonlinear[K], error_nonlinear_ns[K];
I_2[k] = data[k, 1] foreach k in K;
dx_measured[k] = data[k, 15] foreach k in K;
sdx_measured[k] = data[k, 16] foreach k in K;
Transfer(s_11 = s_11; s_12 = s_12; s_22 = s_22; slope_q3 = slope_q3; int_q3 = int_q3; slope_q4 = slope_q4; int_q4 = int_q4; I_2 = I_2[k] :: A_T[k] = A_T; B_T[k] = B_T; C_T[k] = C_T; D_T[k] = D_T; dx_model[k] = dx; dxp_model[k] = dxp) foreach k in K;
foreach k in K {
  error_linear[k] = (dx_model[k]^2 - dx_measured[k]^2)/(2*dx_measured[k]*sdx_measured[k]);
  error_linear_ns[k] = dx_model[k]^2 - dx_measured[k]^2;
  error_nonlinear[k] = (dx_model[k] - dx_measured[k])/sdx_measured[k];
  error_nonlinear_ns[k] = dx_model[k] - dx_measured[k];
}
obj = sum(k in K | error_nonlinear[k]^2);
