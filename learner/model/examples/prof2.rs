//! tmp
#![allow(clippy::unwrap_used, missing_docs)]
use candle_core::*; use driml_model::*; use std::time::Instant; use rand_chacha::rand_core::SeedableRng;
fn cpu()->f64{ let s=std::fs::read_to_string("/proc/self/stat").unwrap(); let f:Vec<&str>=s.rsplit(')').next().unwrap().split_whitespace().collect(); (f[11].parse::<f64>().unwrap()+f[12].parse::<f64>().unwrap())*10. }
fn sys()->f64{ let s=std::fs::read_to_string("/proc/self/stat").unwrap(); let f:Vec<&str>=s.rsplit(')').next().unwrap().split_whitespace().collect(); f[12].parse::<f64>().unwrap()*10. }
fn med(name:&str, mut f: impl FnMut()) { for _ in 0..3 {f()}; let n=40; let (c,s)=(cpu(),sys()); let mut v: Vec<f64>=(0..n).map(|_|{let t=Instant::now(); f(); t.elapsed().as_secs_f64()*1e3}).collect(); let (c,s)=((cpu()-c)/n as f64,(sys()-s)/n as f64); v.sort_by(f64::total_cmp); println!("{name}: min {:.1} q25 {:.1} median {:.1} ms; cpu {c:.1} (sys {s:.1}) ms", v[0], v[n/4], v[n/2]); }
fn main(){
  for (h,w) in [(64,64),(104,80)] {
    let layer = |out, kernel, stride| ConvLayer { out, kernel, stride };
    let config = ModelConfig{height:h,width:w,channels:3,num_actions:15,atoms:51,v_min:-10.,v_max:10.,conv:vec![layer(32,8,4),layer(64,4,2),layer(64,3,1)],hidden:512,rkhs:512,action_embed:64,dim:DimParts{psi3:true,phi3:true,psi4:true,phi4:true,action:true}};
    let p = Parameters::init(&config,&mut rand_chacha::ChaCha8Rng::seed_from_u64(1),&Device::Cpu).unwrap();
    let net = Network::new(&config,&p).unwrap();
    let x = Tensor::from_vec((0..256*h*w*3).map(|i|(i*31%256) as u8).collect::<Vec<u8>>(), (256,h,w,3), &Device::Cpu).unwrap();
    let a = Tensor::from_vec((0..256u32).map(|i|i%15).collect::<Vec<u32>>(), 256, &Device::Cpu).unwrap();
    med(&format!("{h}x{w} fwd"), ||{net.logits(&net.features(&x).unwrap().f4).unwrap();});
    med(&format!("{h}x{w} fwd+bwd"), ||{net.logits(&net.features(&x).unwrap().f4).unwrap().sqr().unwrap().sum_all().unwrap().backward().unwrap();});
    let f = net.features(&x).unwrap(); let (f3,f4)=(f.f3.detach(),f.f4.detach());
    med(&format!("{h}x{w} psi4 fwd+bwd"), ||{net.psi4(&f4,&a).unwrap().sum_all().unwrap().backward().unwrap();});
    med(&format!("{h}x{w} psi3 fwd"), ||{net.psi3(&f3,&a).unwrap();});
    med(&format!("{h}x{w} psi3 fwd+bwd"), ||{net.psi3(&f3,&a).unwrap().sum_all().unwrap().backward().unwrap();});
  }
}
