import{a,b}from"./chunk-TRGNRGKJ.js";export{b as Client,a as ServiceError};
