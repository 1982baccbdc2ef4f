//! tmp
#![allow(clippy::unwrap_used, missing_docs)]
use candle_core::*; use driml_model::*; use std::time::Instant;
fn med(mut f: impl FnMut()) -> f64 { for _ in 0..3 {f()}; let mut v: Vec<f64>=(0..15).map(|_|{let t=Instant::now(); f(); t.elapsed().as_secs_f64()*1e3}).collect(); v.sort_by(f64::total_cmp); v[2] }
fn var(s:&[usize])->Var{ let n:usize=s.iter().product(); Var::from_vec((0..n).map(|i|((i*7919%1009) as f32/1009.-0.5)*0.1).collect::<Vec<f32>>(), s, &Device::Cpu).unwrap() }
fn main(){
  for (name,h,w,c,o,k,s,u8in) in [("c1 64",64,64,3,32,8,4,true),("c2 64",15,15,32,64,4,2,false),("c3 64",6,6,64,64,3,1,false),("c1 104",104,80,3,32,8,4,true),("c2 104",25,19,32,64,4,2,false),("c3 104",11,8,64,64,3,1,false)] {
    let x = if u8in { Tensor::from_vec((0..256*h*w*c).map(|i|(i*31%256) as u8).collect::<Vec<u8>>(), (256,h,w,c), &Device::Cpu).unwrap() } else { var(&[256,h,w,c]).as_tensor().clone() };
    let wt = var(&[o,c,k,k]); let b = var(&[o]);
    let y = conv2d_relu(&x,&wt,&b,s).unwrap();
    let g = y.ones_like().unwrap();
    let f = med(||{conv2d_relu(&x,&wt,&b,s).unwrap();});
    let zero = med(||{ let l=(conv2d_relu(&x,&wt,&b,s).unwrap()*&g).unwrap().sum_all().unwrap(); drop(l);});
    let fb = med(||{ let l=(conv2d_relu(&x,&wt,&b,s).unwrap()*&g).unwrap().sum_all().unwrap(); l.backward().unwrap();});
    let macs = (256*y.dims()[1]*y.dims()[2]*o*c*k*k) as f64;
    println!("{name}: fwd {f:.2} ms ({:.0} GF/s), loss {zero:.2}, all {fb:.2}, bwd {:.2} ideal({:.2})", 2.*macs/f/1e6, fb-zero, f*if u8in {1.} else {2.});
  }
  for (name,r,i,o) in [("fc 64",256,1024,512),("fc 104",256,3456,512),("head",256,512,765),("psi3 hid",4096,64,512),("psi3 out",4096,512,512)] {
    let x = var(&[r,i]); let w=var(&[o,i]); let b=var(&[o]);
    let f = med(||{linear(&x,&w,&b).unwrap();});
    let l1 = med(||{linear(&x,&w,&b).unwrap().sum_all().unwrap();});
    let fb = med(||{linear(&x,&w,&b).unwrap().sum_all().unwrap().backward().unwrap();});
    let m = med(||{x.detach().matmul(&w.detach().t().unwrap()).unwrap();});
    println!("{name}: fwd {f:.2} ms ({:.0} GF/s) matmul {m:.2}; bwd {:.2}", 2.*(r*i*o) as f64/f/1e6, fb-l1);
  }
}
